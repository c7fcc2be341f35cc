"""`jaxik doctor` on this installation, and on ones that are broken in known ways."""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from fitting.cli import main, without_jax
from fitting.cli.doctor import examination, installation, machine, self_test
from fitting.cli.doctor.findings import Finding, from_json
from support.experiments import ROOT


def doctor(*options: str, folder=ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    command = [sys.executable, "-P", "-m", "fitting.cli.main", "doctor", *options]
    variables = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    return subprocess.run(
        command, env=variables | environment, cwd=folder, capture_output=True, text=True
    )


def says_no_more(done: subprocess.CompletedProcess[str]) -> bool:
    """Whether stderr has nothing but what takes long."""
    return all(line.startswith("Importing ") for line in done.stderr.splitlines())


def test_here_all_is_well(tmp_path):
    done = doctor("--quick", folder=tmp_path)
    assert done.returncode == 0, done.stdout
    for subject in ("Python ", "jaxik ", "packages ", "devices ", "XLA flags ", "programs "):
        assert f"  {subject}" in done.stdout
    assert f"jax {metadata.version('jax')}," in done.stdout
    assert done.stdout.endswith("\nall is well\n") and says_no_more(done)


@pytest.mark.slow
def test_the_self_test_passes_here():
    finding = self_test.examine()
    assert not finding.problem and "pelvis.on_gain = 0.15" in finding.fact


@pytest.mark.slow
def test_the_self_test_sees_wrong_numbers(monkeypatch):
    monkeypatch.setattr(self_test, "COST", 1.02 * self_test.COST)
    monkeypatch.setattr(self_test, "LARGEST_ERROR", 0.0)
    problem = self_test.examine().problem
    assert "the motion has a cost of 4348" in problem and "wanted 0.15" in problem


def test_a_flag_that_ends_the_process_is_a_line_with_a_remedy(tmp_path):
    done = doctor("--quick", folder=tmp_path, XLA_FLAGS="--xla_nonsense=1")
    assert done.returncode == without_jax.PROBLEMS_FOUND
    assert "Unknown flag in XLA_FLAGS: --xla_nonsense=1" in done.stdout
    assert "do: unset XLA_FLAGS" in done.stdout and "Traceback" not in done.stdout + done.stderr


def test_it_runs_where_jax_cannot_be_imported(tmp_path):
    (tmp_path / "jax.py").write_text("raise RuntimeError('no AVX')\n", encoding="utf-8")
    done = doctor("--quick", folder=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == without_jax.PROBLEMS_FOUND
    assert "jax cannot be imported: no AVX" in done.stdout
    assert "processor" in done.stdout and says_no_more(done)


def test_a_file_that_hides_a_package_is_named(tmp_path):
    (tmp_path / "fitting.py").touch()
    (finding,) = installation._names_in(tmp_path)
    assert f"{tmp_path / 'fitting.py'} hides the package fitting" in finding.problem
    assert not list(installation._names_in(ROOT))


def test_the_command_itself_is_not_hidden_by_a_file_beside_it(tmp_path):
    command = Path(sys.executable).with_name("jaxik")
    if not command.is_file():
        pytest.skip("jaxik is not installed")
    for name in ("fitting.py", "jaxik.py"):
        (tmp_path / name).write_text("raise RuntimeError('of the folder')\n", encoding="utf-8")
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [command, "--help"], env=variables, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and "Fits the parameters" in done.stdout, done.stderr


@pytest.fixture
def requirements(monkeypatch):
    """What jaxik needs, as the tests say."""
    texts: list[str] = []
    monkeypatch.setattr(installation.metadata, "requires", lambda name: texts)
    return texts


def problems() -> list[str]:
    return [finding.problem for finding in installation.examine() if finding.problem]


def test_a_missing_and_an_old_package_are_problems(requirements):
    requirements += ["numpy>=99", "surely-not-installed>=1"]
    version = metadata.version("numpy")
    assert problems() == [
        f"numpy is {version}, wanted >=99; surely-not-installed is missing",
    ]


def test_an_extra_is_no_problem_unless_it_is_broken(requirements, monkeypatch):
    requirements += ["surely-not-installed; extra == 'dask'", "pdoc>=99; extra == 'posterior'"]
    findings = {finding.subject: finding for finding in installation.examine()}
    assert 'surely-not-installed; pip install "jaxik[dask]"' in findings["extra dask"].fact
    assert not findings["extra dask"].problem
    assert "pdoc is" in findings["extra posterior"].problem
    assert findings["extra posterior"].remedy == 'pip install --upgrade "jaxik[posterior]"'


def test_little_memory_is_a_problem(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "MEMORY", tmp_path / "meminfo")
    (tmp_path / "meminfo").write_text("MemTotal: 4000000 kB\nMemAvailable: 500000 kB\n")
    (*_, memory) = machine.examine()
    assert memory.fact == "4.0 GB, 0.5 GB of them free" and "only 0.5 GB" in memory.problem


def test_an_examination_that_fails_itself_is_a_problem(monkeypatch, capsys):
    def fail():
        raise OSError("no such device")

    monkeypatch.setattr(machine, "examine", fail)
    monkeypatch.setattr(examination, "_in_other_process", lambda options: iter([Finding("a", "b")]))
    assert main.main(["doctor", "--quick"]) == without_jax.PROBLEMS_FOUND
    out = capsys.readouterr().out
    assert "! machine: OSError: no such device\n  do: " in out and out.endswith("1 to mend\n")


def test_only_findings_are_read_from_the_other_process():
    finding = Finding("devices", "cpu", "", "")
    assert from_json(finding.to_json()) == finding
    assert [from_json(line) for line in ("", "{}", "[1]", "3", "I0000 started")] == [None] * 5
