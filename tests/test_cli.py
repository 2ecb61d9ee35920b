"""The command line: fast help, the short form of the main job, bad input."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import hybridjax as hj
from hybridjax.apps.cli import main

from .sessions import run_python


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ("--version", f"hybridjax {hj.__version__}\n"),
        ("--help", "usage: hybridjax"),
        ("reproduce --help", "--seed"),
        ("identify --help", "--crossing"),
        ("sweep --help", "--values"),
    ],
)
def test_help_does_not_import_jax(arguments, text):
    code = (
        "import sys; from hybridjax.apps.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "finally: assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    assert text in run_python("-c", code, *arguments.split())


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("reproduce")
    options = ["--quick", "--out", str(out), "--formats", "png,svg"]
    run_python("-m", "hybridjax", "reproduce", *options)
    return out


@pytest.mark.slow
def test_reproduce_writes_its_results(results):
    summary = json.loads((results / "summary.json").read_text())
    assert summary["limit_cycle"]["period"] == pytest.approx(1.0)
    pairs = np.array(summary["limit_cycle"]["multipliers"])
    multipliers = pairs @ [1, 1j]
    assert multipliers == pytest.approx(
        [
            -0.248983334735609 + 0.699333251798004j,
            -0.248983334735609 - 0.699333251798004j,
        ],
        abs=1e-9,
    )
    for family in ("isochron", "kinematic"):
        result = summary["families"][family]
        assert result["experiments"] == "20/20 ok"
        assert result["multipliers_fit_structured_error"] < 5e-3
    for family in ("isochron", "kinematic"):
        exact, estimate = (
            hj.load(results / f"{x}_{family}.npz") for x in ("exact", "estimate")
        )
        every_harmonic = tuple(range(-16, 16))
        assert exact.harmonics == estimate.harmonics == every_harmonic
        model, fit = (
            hj.load(results / f"{x}_{family}.npz") for x in ("ldtp", "structured")
        )
        assert_allclose(model.htf(exact.frequencies).H, exact.H, atol=1e-12)
        assert fit.compare(model.multipliers).max_error < 5e-3
        stored = hj.load(results / f"rational_{family}.npz")
        assert stored.multipliers.shape == (2, 2)


def test_bad_input_is_one_sentence():
    with pytest.raises(
        SystemExit, match="^hybridjax: cannot write to '/dev/null/x'.*"
    ) as error:
        main(["reproduce", "--out", "/dev/null/x"])
    assert "\n" not in str(error.value)


WRONG = {
    "reproduce": {
        "": "required: --out",
        "--out x --seed -1": "--seed: '-1' is not a whole number from 0 on",
        "--out x --formats gif": "--formats: 'gif' is not one or more of png, pdf, svg",
        "--out=": "--out: '' is not a name",
    },
    "identify x.csv --out x --inputs u --outputs y": {
        "": "one of the arguments --phase --crossing --event is required",
        "--phase y,v --event e": "not allowed with argument --phase",
        "--phase y": "--phase: 'y' is not two names with a comma in between",
        "--event e --center 1,2": "--center and --scale are of the angle of --phase",
        "--phase y,v --center 1": "--center: '1' is not two numbers",
        "--phase y,v --scale 1,-2": "--scale: '1,-2' is not two positive numbers",
        "--event e --order 1000000000000": "--order: '1000000000000' is not a whole number",
        "--event e --drift 2": "--drift: '2' is not a number of cycles, four or more",
        "--event e --drift inf": "--drift: 'inf' is not a number of cycles, four or more",
        "--event e --bandwidth 0": "--bandwidth: '0' is not a positive number",
        "--event e --sections 8.5": "--sections: '8.5' is not a whole number from 1 to",
        "--crossing u:falling": "u is an input: define the phase by another signal",
        "--event e z": "unrecognized arguments: z (names need commas)",
        "--event e --references u": "u: name it once (omit --references without a controller)",
        "--crossing y:up": "'y:up' is not a signal, a direction and a value",
        "--crossing y:rising:nan": "'y:rising:nan' is not a signal, a direction and a value",
    },
    "identify x.csv --out x --inputs u": {
        "--phase y,v": "name --outputs, or choose --timing"
    },
    "": {
        "": "name one of the commands",
        "fly": "invalid choice: 'fly'",
    },
}


def wrong_calls():
    for command, rows in WRONG.items():
        for options, message in rows.items():
            yield command, options, message


@pytest.mark.parametrize(("command", "options", "message"), list(wrong_calls()))
def test_wrong_options(tmp_path, monkeypatch, capsys, command, options, message):
    """Said before anything is imported, read or written, with the usage and exit status 2."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        main([*command.split(), *options.split()])
    said = capsys.readouterr().err
    assert error.value.code == 2
    assert said.startswith("usage: hybridjax")
    assert message in said.splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.fixture
def protocols(monkeypatch):
    """What `reproduce` would be asked for; it does nothing, and converges."""
    asked = []

    def reproduce(out, protocol, formats):
        assert formats == ("png",)
        asked.append(protocol)
        return {"families": {"isochron": {"converged": protocol.seed == 0}}}

    monkeypatch.setattr("hybridjax.apps.reproduce.reproduce", reproduce)
    return asked


def test_the_short_form_has_other_sizes_and_failures_are_said(protocols, capsys):
    for options, sizes in {"": (80, 84, 64), "--quick": (20, 36, 16)}.items():
        arguments = ["reproduce", "--out", "x", *options.split()]
        assert main(arguments) == 0
        protocol = protocols.pop()
        assert (protocol.experiments, protocol.cycles, protocol.keep) == sizes
    assert main(["reproduce", "--out", "x", "--seed", "1"]) == 1
    assert "a fit did not converge" in capsys.readouterr().err


def test_an_interruption_is_one_line(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("hybridjax.apps.reproduce._reproduce", interrupted)
    with pytest.raises(SystemExit) as error:
        main(["reproduce", "--out", str(tmp_path / "new")])
    assert error.value.code == 130
    assert capsys.readouterr().err == "hybridjax: interrupted.\n"
    assert not list(tmp_path.iterdir())


def test_the_main_job_imports_what_it_needs():
    """And nothing else that takes long."""
    heavy = (
        "diffrax",
        "optimistix",
        "lineax",
        "scipy.linalg",
        "scipy.special",
        "matplotlib",
    )
    code = f"import sys, hybridjax.apps.reproduce\nprint([m for m in {heavy} if m in sys.modules])"
    assert run_python("-c", code) == "[]\n"
