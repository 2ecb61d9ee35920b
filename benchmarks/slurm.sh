#!/bin/bash
# Slurm on this machine alone, and the recipe of docs/how-to/scale.md through dask-jobqueue.
#
#     sudo benchmarks/slurm.sh     (Debian: installs slurm-wlm and munge; needs dask-jobqueue)
#
# Ends with 0 where Slurm cannot be installed, and says so.
set -e
here=$(cd "$(dirname "$0")" && pwd)
if ! command -v slurmctld > /dev/null; then
    apt-get install -y -q slurm-wlm munge > /dev/null 2>&1 || {
        echo "slurm: skipped, slurm-wlm cannot be installed here"
        exit 0
    }
fi
name=$(hostname -s)
mkdir -p /etc/slurm /var/spool/slurmctld /var/spool/slurmd /run/munge
cat > /etc/slurm/slurm.conf << CONF
ClusterName=one
SlurmctldHost=$name
SlurmUser=root
AuthType=auth/munge
StateSaveLocation=/var/spool/slurmctld
SlurmdSpoolDir=/var/spool/slurmd
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
NodeName=$name CPUs=$(nproc) RealMemory=$(($(awk '/MemTotal/ {print $2}' /proc/meminfo) / 1100)) State=UNKNOWN
PartitionName=all Nodes=$name Default=YES MaxTime=INFINITE State=UP
CONF
cleanup() { kill "$munged" "$slurmctld" "$slurmd" 2> /dev/null || true; }
trap cleanup EXIT
chown -R munge: /run/munge /etc/munge /var/lib/munge /var/log/munge
runuser -u munge -- munged --foreground & munged=$!
sleep 2
slurmctld -D > /tmp/slurmctld.log 2>&1 & slurmctld=$!
slurmd -D > /tmp/slurmd.log 2>&1 & slurmd=$!
for _ in $(seq 60); do
    sinfo -h -o %T 2> /dev/null | grep -q idle && break
    sleep 1
done
sinfo
"${PYTHON:-python}" "$here/slurm.py"
