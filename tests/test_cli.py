"""The command line: fast help, the short form of the main job, bad input."""

import json
import subprocess
import sys

import numpy as np
import pytest

import hybridjax as hj
from hybridjax.apps.cli import main


def _python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True)


@pytest.mark.parametrize("arguments", [["--help"], ["reproduce", "--help"]])
def test_help_does_not_import_jax(arguments):
    code = (
        "import sys; from hybridjax.apps.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit: pass\n"
        "print('heavy:', [m for m in ('jax', 'numpy', 'matplotlib') if m in sys.modules])"
    )
    run = _python("-c", code, *arguments)
    assert run.returncode == 0 and "usage: hybridjax" in run.stdout
    assert "heavy: []" in run.stdout


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("reproduce")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hybridjax.apps.reproduce.enable_compilation_cache", lambda: None)
        main(["reproduce", "--quick", "--out", str(out), "--param", "M=2.0"])
    return out


def test_reproduce_writes_its_results(results):
    summary = json.loads((results / "summary.json").read_text())
    assert summary["limit_cycle"]["period"] == pytest.approx(1.0)
    multipliers = np.array(summary["limit_cycle"]["multipliers"]) @ [1, 1j]
    assert multipliers == pytest.approx(
        [-0.248983334735609 + 0.699333251798004j, -0.248983334735609 - 0.699333251798004j], abs=1e-9
    )
    for family in ("isochron", "kinematic"):
        found = summary["families"][family]
        assert found["experiments"] == "20/20 ok"
        assert found["multipliers_fit_structured_error"] < 5e-3
    with np.load(results / "results.npz", allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        F = len(file["f"])
        for family in ("isochron", "kinematic"):
            assert file[f"H_exact_{family}"].shape == (32, F, 2, 1)
            assert file[f"H_estimate_{family}"].shape == (32, F, 2, 1)
            d = file[f"A_{family}"].shape[1]
            assert file[f"A_{family}"].shape == (32, d, d) and file[f"B_{family}"].shape == (
                32,
                d,
                1,
            )
            assert file[f"C_{family}"].shape == (32, 2, d) and file[f"D_{family}"].shape == (
                32,
                2,
                1,
            )
            times = file[f"section_times_{family}"]
            assert np.all(np.diff(times) > 0) and times[-1] < times[0] + 1
            assert np.all((file["event_times"] >= times[0]) & (file["event_times"] < times[0] + 1))
            assert file[f"section_states_{family}"].shape == (32, 4)
            assert file[f"multipliers_fit_2p1z_{family}"].shape == (2, 2)
            assert file[f"multipliers_fit_structured_{family}"].shape == (2,)
            dims = file[f"dims_{family}"]
            assert [len(c) for c in header["coordinates"][family]] == dims.tolist()
        assert file["harmonics"].tolist() == list(range(-16, 16))


def test_reproduce_draws_its_figures(results):
    names = ["fig1_cycle_isochron", "fig1_cycle_kinematic", "fig3_harmonics", "fig4_bode"]
    for name in (*names, "multipliers", "poles_zeros"):
        assert (results / f"{name}.png").stat().st_size > 10_000
        assert (results / f"{name}.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--param", "q=1"], "no parameter 'q'; parameters are m, M"),
        (["--param", "M=nan"], "parameter `M` of VerticalHopper is nan"),
        (["--experiments", "10"], "10 experiments are too few"),
        (["--keep", "84"], "leaves no cycle to discard"),
        (["--out", "/dev/null/x"], "cannot be written"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, monkeypatch, arguments, message):
    monkeypatch.setattr("hybridjax.apps.reproduce.enable_compilation_cache", lambda: None)
    with pytest.raises(SystemExit) as error:
        main(["reproduce", "--out", str(tmp_path), *arguments])
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "arguments", [["--param", "M"], ["--cycles", "0"], ["--family", "all"], []]
)
def test_bad_syntax(capsys, arguments):
    with pytest.raises(SystemExit) as error:
        main(["reproduce", *arguments])
    assert error.value.code == 2
    assert "usage: hybridjax reproduce" in capsys.readouterr().err


def test_version():
    assert hj.__version__ == "0.1.0"
