#!/usr/bin/env bash
# Build the site and copy it to any static host: docs/publish.sh user@host:/var/www/hybridjax, or a folder.
# What is there and does not belong to the site is removed. (GitHub Pages: `mkdocs gh-deploy`.)
set -euo pipefail
target=${1:?usage: docs/publish.sh TARGET OF RSYNC}
cd "$(dirname "$0")/.."
site=$(mktemp -d)
trap 'rm -rf "$site"' EXIT
mkdocs build --strict --quiet --site-dir "$site"
rsync --recursive --links --times --delete --chmod=D755,F644 "$site/" "$target/"
