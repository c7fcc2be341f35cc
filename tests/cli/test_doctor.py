"""`jaxik doctor` on this installation, and on ones that are broken in known ways."""

import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from fitting.cli import examination, main, self_test, status, with_jax
from fitting.cli.examination import Finding, from_json
from fitting.experiment import problems
from fitting.runtime import machine, xla
from support import quick
from support.experiments import ROOT


def doctor(folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, which says no more on stderr than what takes long."""
    command = [sys.executable, "-P", "-m", "fitting.cli.main", "doctor", "--quick"]
    variables = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        command, env=variables | environment, cwd=folder, capture_output=True, text=True
    )
    assert all(line.startswith("Importing ") for line in done.stderr.splitlines())
    return done


@pytest.mark.slow
def test_here_all_is_well_and_it_runs_where_jax_cannot_be_imported(tmp_path):
    done = doctor(tmp_path)
    assert done.returncode == 0, done.stdout
    for subject in ("Python ", "jaxik ", "packages ", "devices ", "XLA flags ", "programs "):
        assert f"  {subject}" in done.stdout
    assert f"jax {metadata.version('jax')}," in done.stdout
    assert done.stdout.endswith("\nall is well\n")
    for extra in ("distributed", "bokeh", "ipykernel", "nbclient", "pandas", "arviz_stats"):
        (tmp_path / f"{extra}.py").touch()  # is imported at once
    (tmp_path / "jax.py").write_text("raise RuntimeError('no AVX')\n", encoding="utf-8")
    (tmp_path / "rich.py").write_text("raise ImportError('not here')\n", encoding="utf-8")
    done = doctor(tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == status.PROBLEMS_FOUND
    assert "rich cannot be imported: not here" in done.stdout
    assert "jax cannot be imported: no AVX" in done.stdout and "processor" in done.stdout


def test_an_accelerator_that_commands_leave_alone_is_named(monkeypatch):
    for installed, said in (
        ([], "cpu: cpu"),
        (["xla_cuda13"], "xla_cuda13 is not used: commands "),
    ):
        monkeypatch.setattr(xla, "accelerators", lambda installed=installed: installed)
        findings = {finding.subject: finding for finding in with_jax.examine(quick=True)}
        fact = findings["devices"].fact
        assert said in fact and ("not used" in fact) == bool(installed)


def test_a_flag_that_ends_the_process_is_a_line_with_a_remedy(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(examination, "examine_installation", lambda: iter(()))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("XLA_FLAGS", "--xla_nonsense=1")
    assert main.main(["doctor", "--quick"]) == status.PROBLEMS_FOUND
    output = capsys.readouterr()
    assert "Unknown flag in XLA_FLAGS: --xla_nonsense=1" in output.out
    assert "do: unset XLA_FLAGS" in output.out and "Traceback" not in output.out + output.err


def test_the_advice_on_a_variable_of_jax_is_to_unset_it(tmp_path):
    done = doctor(tmp_path, PYTHONPATH=str(ROOT), JAX_NUM_CPU_DEVICES="x")
    wanted = '! {}: Invalid value "x" for JAX flag jax_num_cpu_devices\n  do: correct or unset '
    for subject in ("packages", "JAX"):
        assert wanted.format(subject) in done.stdout
    assert done.stdout.endswith("2 to mend\n")


@pytest.mark.slow
def test_the_self_test_passes_here():
    finding = self_test.examine()
    assert not finding.problem and "pelvis.half_life = 0.142" in finding.fact


def test_the_self_test_fits_one_parameter_of_a_clip_whose_truth_is_known(monkeypatch):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    finding = self_test.examine()
    assert re.search(r"a fit \(pelvis.half_life = 0\.(3|29\d*|30\d*)\) in ", finding.fact)
    assert "the motion has a cost of" in finding.problem and "wanted 4348" in finding.problem
    assert re.search(r"the fit found pelvis.half_life = 0.\d+, wanted 0.142167$", finding.problem)


@pytest.mark.parametrize(
    ("cost", "slope", "errors", "problem"),
    [
        (1.0, 2.0, 3.9, ""),
        (1.009, 2.0, -3.9, ""),
        (1.011, 2.0, 0.0, "the motion has a cost of 4396"),
        (0.989, 2.0, 0.0, "the motion has a cost of 4300"),
        (1.0, 0.0, 0.0, "derivatives are 0 or not finite"),
        (1.0, np.nan, 0.0, "derivatives are 0 or not finite"),
        (1.0, 2.0, 4.1, "the fit found pelvis.half_life = 2.05, wanted 0.142167"),
    ],
)
def test_the_self_test_sees_wrong_numbers(cost, slope, errors, problem, monkeypatch):
    def descend(_, values, steps):
        u = np.array([0.0 if values else errors / 2.0])
        jacobian = np.array([[slope], [0.0]])
        return SimpleNamespace(u=u, cost=cost * self_test.COST, jacobian=jacobian)

    space = SimpleNamespace(values=lambda u: u)
    monkeypatch.setattr(problems, "make_problem", lambda _: SimpleNamespace(space=space))
    monkeypatch.setattr(self_test, "_descend", descend)
    found = self_test.examine().problem
    assert problem in found and bool(found) == bool(problem)


def test_a_file_that_hides_a_package_is_named_and_does_not_hide_it_from_the_command(tmp_path):
    for name in ("fitting.py", "jaxik.py"):
        (tmp_path / name).write_text("raise RuntimeError('of the folder')\n", encoding="utf-8")
    problem = " ".join(finding.problem for finding in examination._names_in(tmp_path))
    assert f"{tmp_path / 'fitting.py'} hides the package fitting" in problem
    assert not list(examination._names_in(ROOT))
    command = Path(sys.executable).with_name("jaxik")
    if not command.is_file():
        pytest.skip("jaxik is not installed")
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    said = subprocess.check_output([command, "--help"], env=variables, cwd=tmp_path, text=True)
    assert "Fits the parameters" in said


def test_a_missing_and_an_old_package_are_problems_and_an_extra_only_if_it_is_broken(monkeypatch):
    needed = ["numpy>=99", "surely-not-installed>=1"]
    monkeypatch.setattr(examination.metadata, "requires", lambda name: needed)
    said = [finding.problem for finding in examination.examine_installation() if finding.problem]
    numpy = f"numpy is {metadata.version('numpy')}, wanted >=99"
    assert said == [f"{numpy}; surely-not-installed is missing"]
    needed = ["surely-not-installed; extra == 'dask'", "pdoc>=99; extra == 'posterior'"]
    findings = {finding.subject: finding for finding in examination.examine_installation()}
    assert 'surely-not-installed; pip install "jaxik[dask]"' in findings["extra dask"].fact
    assert not findings["extra dask"].problem
    assert "pdoc is" in findings["extra posterior"].problem
    assert findings["extra posterior"].remedy == 'pip install --upgrade "jaxik[posterior]"'


def test_little_memory_and_an_examination_that_fails_itself_are_problems(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(machine, "PROC", tmp_path)
    (tmp_path / "meminfo").write_text("MemTotal: 4000000 kB\nMemAvailable: 500000 kB\n")
    (*_, memory) = examination.examine_machine()
    assert memory.fact == "4.0 GB, 0.5 GB of them free" and "only 0.5 GB" in memory.problem
    monkeypatch.setattr(examination, "examine_machine", Mock(side_effect=OSError("no such device")))
    monkeypatch.setattr(examination, "_in_other_process", lambda options: iter([Finding("a", "b")]))
    assert main.main(["doctor", "--quick"]) == status.PROBLEMS_FOUND
    out = capsys.readouterr().out
    assert "! machine: OSError: no such device\n  do: " in out and out.endswith("1 to mend\n")


def test_only_findings_are_read_from_the_other_process():
    finding = Finding("devices", "cpu", "", "")
    assert from_json(finding.to_json()) == finding
    assert [from_json(line) for line in ("", "{}", "[1]", "3", "I0000 started")] == [None] * 5
