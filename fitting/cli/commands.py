"""One function per command: reads the options, calls the job, prints."""

import argparse
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from fitting import jobs
from fitting.bench import report as bench_report
from fitting.bench import runner, suite
from fitting.bench.sizes import FULL, QUICK
from fitting.datasets.clips import load_clip, summary
from fitting.datasets.terrain.reconstruction import reconstruct
from fitting.experiments import parameter_files, record_files, systems
from fitting.report import terrain_report
from fitting.report.formatting import aligned
from fitting.runtime import cache_folder, files
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import error_context, in_one_line
from fitting.studies import comparison, translation
from fitting.studies.animations import AnimationFiles
from fitting.studies.fit import Fit
from fitting.studies.suite import situations
from fitting.studies.translation import TranslationRequest
from jaxik import FootIK, Rig, record

from . import progress

NOT_CONVERGED, DOES_NOT_FIT, OUTSIDE = 3, 4, 5  # exit statuses


def fit(options: argparse.Namespace) -> int:
    """Fits an experiment."""
    _prepare_jax()
    with progress.ProgressLine(progress.fit_line) as line:
        fitted = jobs.fit(options.experiment, options.output, progress=line, log=print)
    return _fit_status(fitted)


def ablate(options: argparse.Namespace) -> int:
    """Fits an experiment without each of its rules."""
    _prepare_jax()
    with progress.ProgressLine(progress.fit_line) as line:
        jobs.ablate(
            options.experiment, options.output, folds=options.folds, progress=line, log=_print_now
        )
    return 0


def calibrate(options: argparse.Namespace) -> int:
    """Fits an experiment to simulated motion; status 5 if something is outside."""
    _prepare_jax()
    with progress.ProgressLine(progress.calibration_line) as line:
        assessment = jobs.calibrate(
            options.experiment,
            options.output,
            replicates=options.replicates,
            chains=options.chains,
            noise_factor=options.noise_factor,
            workers=options.workers,
            scheduler=options.scheduler,
            progress=line,
            log=_print_now,
        )
    return 0 if assessment.inside else OUTSIDE


def population(options: argparse.Namespace) -> int:
    """Fits several clips and subjects as a population."""
    _prepare_jax()
    with progress.ProgressLine(progress.fit_line) as line:
        fitted = jobs.population(options.experiment, options.output, progress=line, log=_print_now)
    return 0 if fitted.converged else NOT_CONVERGED


def sample(options: argparse.Namespace) -> int:
    """Samples the posterior of a run, or continues its chain."""
    _prepare_jax()
    with progress.ProgressLine(progress.sample_line) as line:
        posterior = jobs.sample(options.run, max_steps=options.max_steps, progress=line, log=print)
    return _status(interrupted=posterior.interrupted)


def apply(options: argparse.Namespace) -> int:
    """Runs the fitted parameters of a run on a clip."""
    _prepare_jax()
    jobs.apply(options.run, _animation(options), options.output, log=print)
    return 0


@in_float64
def run(options: argparse.Namespace) -> int:
    """Runs a preset or a parameter file on a clip."""
    _prepare_jax()
    animation = _animation(options)
    rig = animation.flat_clip.rig
    if options.parameters is not None:
        ik, _ = parameter_files.load_system(options.parameters, rig)
    else:
        ik = systems.preset_system(options.preset, rig)
    jobs.solve(ik, animation, options.output, log=print)
    return 0


@in_float64
def compare(options: argparse.Namespace) -> int:
    """Runs several systems on a clip or through the suite, or compares runs."""
    _prepare_jax()
    if options.suite:
        return _compare_in_suite(options)
    if options.runs is not None:
        return _compare_runs(options)
    _check_comparison(options)
    animation = _animation(options)
    requested = comparison.named_systems(options.systems, animation.flat_clip.rig)
    jobs.compare(
        requested, animation, options.output,
        rates=options.rates, during=progress.timed, log=print,
    )  # fmt: skip
    return 0


@in_float64
def translate(options: argparse.Namespace) -> int:
    """Fits one system to the motion of another."""
    _prepare_jax()
    if len(options.clip) != len(options.terrain):
        raise ValueError(
            f"{len(options.clip)} clip(s) and {len(options.terrain)} terrain(s); wanted a terrain "
            "for each clip"
        )
    animations = tuple(
        AnimationFiles(clip, mesh, options.file_up)
        for clip, mesh in zip(options.clip, options.terrain, strict=True)
    )
    rig = animations[0].flat_clip.rig
    source = translation.load_named_system(options.source, "--from", rig)
    target = translation.load_named_system(options.target, "--to", rig)
    free = None if options.free is None else translation.read_free(options.free, target.ik, rig)
    request = TranslationRequest(source, target, animations, free, options.fps)
    with progress.ProgressLine(progress.fit_line) as line:
        fitted = jobs.translate(request, options.output, progress=line, log=print)
    return _fit_status(fitted)


def inspect(options: argparse.Namespace) -> int:
    """Prints what a loader understood of a clip."""
    clip = load_clip(options.clip, asf=options.asf, scale=options.scale)
    described = summary.describe(clip)
    print(summary.as_json(described) if options.json else summary.as_text(described))
    return 0


@in_float64
def terrain(options: argparse.Namespace) -> int:
    """Reconstructs the ground of a clip; writes a mesh, its numbers and a plot."""
    terrain_report.check_output_files(options.output)
    clip = load_clip(options.clip)
    kind = None if options.model == "auto" else options.model
    ground = reconstruct(clip, sole=options.sole, kind=kind)
    terrain_report.write(options.output, ground, clip, options.sole, options.margin)
    print(f"{terrain_report.count_stances(ground)}\n")
    print(aligned(terrain_report.prediction_table(ground)))
    print(f"\n{terrain_report.describe_surface(ground)}; written to {options.output}")
    return 0


def bench(options: argparse.Namespace) -> int:
    """Measures speed on this machine; uses no cache of programs."""
    chosen = suite.choose(suite.BENCHMARKS, options.only, options.quick)
    plot = bench_report.check_output_files(options.json, options.plot)
    sizes = QUICK if options.quick else FULL
    with progress.ProgressLine(str) as line:
        report = runner.run_benchmarks(chosen, sizes, options.quick, progress.print_line, line)
    written = bench_report.write(report, options.json, plot)
    print(bench_report.text(report))
    for path in written:
        print(f"written to {path}")
    return _status(interrupted=report.interrupted)


@in_float64
def convert_record(options: argparse.Namespace) -> int:
    """Shows the game's record, or converts it from or to our parameters."""
    reading = record.Reading(options.length_unit, options.knee, options.lean_sign, options.tick_hz)
    base_path = getattr(options, "base", None)  # an option of to-bytes only
    base = None if base_path is None else record_files.read_binary(base_path)
    records = record_files.read(options.file, reading, base)
    if options.way == "show":
        if options.csv:
            print(record.to_csv(records).rstrip())
        else:
            with error_context(options.file):
                print("\n\n".join(record_files.describe(entry, reading) for entry in records))
        return 0
    (only, *more) = records
    if more:
        raise ValueError(f"{options.file} has {1 + len(more)} rows; give a file with one record")
    if options.way == "to-toml":
        with error_context(options.file):
            text = parameter_files.system_to_toml(
                record.to_ik(only, reading), systems.Preset("record", faithful=True)
            )
        files.write_text(options.output, text)
        if (rest := record.besides_parameters(only)) != record.besides_parameters(record.Record()):
            warnings.warn(
                f"{', '.join(rest)}: no parameters, so not in {options.output}; `record to-bytes` "
                f"takes them from --base {options.file}",
                stacklevel=2,
            )
    else:
        files.write(options.output, lambda path: path.write_bytes(record.to_bytes(only)))
    print(f"written to {options.output}")
    return 0


def cache(options: argparse.Namespace) -> int:
    """Shows where programs are kept between calls, or removes them."""
    cache_folder.use_default()
    folder = Path(str(cache_folder.setting(cache_folder.FOLDER) or cache_folder.default()))
    traced, compiled = cache_folder.kept_programs(folder)
    if options.clear:
        size = _megabytes([*traced, *compiled])
        for path in (*traced, *compiled):
            path.unlink(missing_ok=True)
        print(f"removed {len(traced)} traced and {len(compiled)} compiled, {size}, from {folder}")
        return 0
    print(f"place              {folder}")
    print(f"traced programs    {len(traced)} ({_megabytes(traced)})")
    print(f"compiled programs  {len(compiled)} ({_megabytes(compiled)})")
    try:
        cache_folder.traced()
        print("used               yes")
    except (cache_folder.SwitchedOffError, OSError) as error:
        print(f"used               no: {in_one_line(error)}")
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "fit": fit,
    "ablate": ablate,
    "calibrate": calibrate,
    "population": population,
    "sample": sample,
    "apply": apply,
    "run": run,
    "compare": compare,
    "translate": translate,
    "inspect": inspect,
    "terrain": terrain,
    "bench": bench,
    "record": convert_record,
    "cache": cache,
}


def _compare_in_suite(options: argparse.Namespace) -> int:
    """Runs systems, or else all presets, through made situations."""
    if options.runs is not None:
        raise ValueError("--runs and --suite exclude each other")
    own = {"CLIP": None, "--terrain": None, "--file-up": "y", "--floor": 0.0, "--root": "auto"}
    own["--rates"] = []
    for name, unused in own.items():
        given = getattr(options, name.strip("-").replace("-", "_").lower())
        if given != unused:
            raise ValueError(f"{name} is {given}; the suite has animations and grounds of its own")
    requested = options.systems or [("--presets", ",".join(systems.preset_names()))]
    comparison.named_systems(requested)  # reports mistakes before anything runs
    plan = situations.choose(options.only, quick=options.quick)

    def systems_of(rig: Rig) -> dict[str, FootIK]:
        return comparison.named_systems(requested, rig)

    finished = jobs.run_suite(
        systems_of, plan, options.output, during=progress.timed, log=progress.print_marked
    )
    return _status(interrupted=finished.interrupted)


def _compare_runs(options: argparse.Namespace) -> int:
    """Compares sampled runs by what they predict."""
    own = {"CLIP": options.clip, "--terrain": options.terrain, "--rates": options.rates}
    for name, given in own.items():
        if given:
            raise ValueError(f"{name} is {given}; runs are compared on the clips of their fits")
    if options.systems:
        raise ValueError(f"{options.systems[0][0]} and --runs exclude each other")
    jobs.compare_runs(options.runs.split(","), options.output, log=print)
    return 0


def _check_comparison(options: argparse.Namespace) -> None:
    """Raises ValueError for what only the suite takes, or only a comparison on a clip needs."""
    for name in ("only", "quick"):
        if getattr(options, name):
            raise ValueError(f"--{name} belongs to --suite, which is not given")
    needed = {"CLIP": options.clip, "--terrain": options.terrain, "-o/--output": options.output}
    if missing := [name for name, given in needed.items() if given is None]:
        raise ValueError(f"the following are required: {', '.join(missing)}; or --suite, or --runs")


def _prepare_jax() -> None:
    """Keeps programs between calls."""
    cache_folder.use_default()


def _animation(options: argparse.Namespace) -> AnimationFiles:
    return AnimationFiles(
        options.clip,
        options.terrain,
        options.file_up,
        options.floor,
        options.root,
        options.speed,
        options.tracks,
    )


def _megabytes(paths: Sequence[Path]) -> str:
    return f"{sum(path.stat().st_size for path in paths) / 1e6:.1f} MB"


def _status(*, interrupted: bool) -> int:
    """The exit status of a job whose results are written; an interrupt goes on to `main`."""
    if interrupted:
        raise KeyboardInterrupt
    return 0


def _fit_status(fitted: Fit) -> int:
    """The exit status of a search; what a translation leaves over is a result, and no failure."""
    _status(interrupted=fitted.solution.interrupted)
    if not fitted.solution.converged:
        return NOT_CONVERGED
    return DOES_NOT_FIT if fitted.has_noise and not fitted.verdict.fits else 0


def _print_now(text: str) -> None:
    """Prints without waiting for a full buffer: the next line may take an hour."""
    print(text, flush=True)
