"""The command remodel-fenicsx: thin, no numerics."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shlex
import sys
import time as clock
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.reductions import explained
from remodel_fenicsx.scene.presets import PRESETS, PROFILES
from remodel_fenicsx.scene.scene import Scene, SceneError, preset_scene, read_scene
from remodel_fenicsx.schema.tables import printable
from remodel_fenicsx.system import interrupts
from remodel_fenicsx.system.arguments import MOST_RUNS, megabytes, positive, wall_time
from remodel_fenicsx.system.children import SERVE, serve
from remodel_fenicsx.system.environment import kernels, reason_undrawable, reason_unusable, versions
from remodel_fenicsx.system.regular_files import ForeignFileError, write_new

BAD_INPUT, SOLVE_FAILED, STOPPED, BAD_ENVIRONMENT = 2, 3, interrupts.PAUSED, 5
STUDY_STOPPED = "stopped; all that is recorded is kept, the same command goes on"
EXIT_CODES = {
    0: "finished",
    BAD_INPUT: "bad input",
    SOLVE_FAILED: "the solve failed",
    STOPPED: "stopped on purpose",
    BAD_ENVIRONMENT: "environment not usable",
    129: "hung up",
    130: "interrupted",
    143: "terminated",
}


class _UnusableEnvironment(Exception):  # noqa: N818
    """What a command needs is missing; the text says what."""


def _check(reason: str | None) -> None:
    if reason is not None:
        raise _UnusableEnvironment(reason)


class _Parser(argparse.ArgumentParser):
    """What it complains of stays on one line, control characters and all."""

    def error(self, message: str) -> NoReturn:
        super().error(printable(message))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    main_parser = _Parser(
        prog="remodel-fenicsx",
        description="Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007).",
        epilog="exit codes: " + ", ".join(f"{code} {meaning}" for code, meaning in EXIT_CODES.items()),
    )
    main_parser.add_argument("--version", action="version", version=__version__)
    commands = main_parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text)

    def scene_command(name: str, text: str) -> argparse.ArgumentParser:
        """One that reads a scene, which `run --resume` finds in the folder."""
        found, meaning = command(name, text), "scene file (TOML), see docs/scene.md"
        if name == "run":
            which = found.add_mutually_exclusive_group(required=True)
            which.add_argument("scene", type=Path, nargs="?", metavar="SCENE", help=meaning)
            text = "go on with the run in DIR from its last checkpoint"
            which.add_argument("--resume", type=Path, metavar="DIR", help=text)
        else:
            found.add_argument("scene", type=Path, metavar="SCENE", help=meaning)
        text = "set a key of the scene, e.g. cells.seed=2 or time.end=10; may be repeated"
        found.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=text)
        found.add_argument("--profile", choices=PROFILES, help="lay the settings of a profile over the scene's own")
        return found

    def writes(found: argparse.ArgumentParser, text: str) -> None:
        found.add_argument("-o", "--output", type=Path, metavar="DIR", help=text)

    run_command = scene_command("run", "Run a scene; mpirun -n N remodel-fenicsx run ... is the same run on N ranks.")
    writes(run_command, "new or empty folder for the results (default: results/NAME)")
    text = "stop before this time is over, after a whole step, with exit code 4: 90s, 30min, 2h, 1.5d"
    run_command.add_argument("--max-wall-time", type=wall_time, metavar="TIME", help=text)
    text = "leave no report.html at the end, as with output.report = false"
    run_command.add_argument("--no-report", dest="report", action="store_false", help=text)
    stability = scene_command("stability", "Run a scene and say whether its passes damp small changes of the cells.")
    writes(stability, "new or empty folder (default: results/NAME-stability)")
    stability.add_argument("--times", type=positive, default=10, metavar="N", help="times to analyse (default: 10)")
    stability.set_defaults(resume=None, max_wall_time=None, report=False)
    ensemble = scene_command("ensemble", "Run a scene of random cells with many seeds, and with isotropic cells.")
    ensemble.add_argument("--seeds", type=positive, default=32, metavar="N", help="how many (default: 32; at least 2)")
    trade = scene_command("trade", "Run a scene with a ladder of settings: what each costs, and how far off it is.")
    text = "wall time for the runs: 90s, 10min, 2h (default: 10min); cheap settings first"
    trade.add_argument("--budget", type=wall_time, default=600.0, metavar="TIME", help=text)
    sweep = scene_command("sweep", "Run a scene with other numbers: how its end depends on them.")
    text = "KEY=a:b:n (n numbers from a to b) or KEY=a,b,...; of several all combinations are run"
    sweep.add_argument("axes", nargs="+", metavar="KEY=a:b:n", help=text)
    text = "N points of a Latin hypercube in place of all combinations; then each key is KEY=a:b"
    sweep.add_argument("--latin", type=positive, metavar="N", help=text)
    sweep.add_argument("--seed", type=int, default=1, metavar="N", help="of the Latin hypercube (default: 1)")
    for study, name in ((ensemble, "ensemble"), (trade, "trade"), (sweep, "sweep")):
        text = "finished runs of the same scene that it holds are used, others go on"
        writes(study, f"folder (default: results/NAME-{name}); {text}")
        study.add_argument("--jobs", type=positive, metavar="N", help="runs at a time (default: as many as cores)")
    fitting = scene_command("fit", "Fit numbers of a scene to measurements, with 95 % bands.")
    text = "the unknowns, and tables of measurements (TOML), see docs/fit.md"
    fitting.add_argument("data", type=Path, metavar="DATA", help=text)
    writes(fitting, "new or empty folder, or that of the same fit, which goes on (default: results/NAME-fit)")
    text = "the given one, and others within a factor of two (default: 3)"
    fitting.add_argument(
        "--no-likelihood-profiles", dest="profiles", action="store_false", help="of unknowns that go together"
    )
    fitting.add_argument("--starts", type=positive, default=3, metavar="N", help=text)
    for found in (run_command, stability, ensemble, trade, sweep, fitting):
        found.add_argument("-q", "--quiet", action="store_true", help="no progress")
    status = command("status", "Say where the run in DIR is, how fast, and whether it is alive.")
    status.add_argument("folder", type=Path, metavar="DIR", help="folder of a run")
    report = command(
        "report", "Make the page of the run in DIR for a browser, also while it runs; it needs no network."
    )
    report.add_argument("folder", type=Path, metavar="DIR", help="folder of a run")
    text = "a file that does not exist yet (default: DIR/report.html, which is made anew)"
    report.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    text = "MB that the page may have (default: %(default)g): where it would be larger fewer times are shown"
    report.add_argument("--size", type=megabytes, default=20.0, metavar="MB", help=text)
    report.add_argument("--open", action="store_true", help="show it in a browser")
    picture = command("picture", "Draw the body of the run in DIR: PNG, SVG or PDF.")
    animate = command("animate", "Draw the body of the run in DIR as it moves: GIF or WebP, MP4 where ffmpeg is.")
    for found, default in ((picture, "DIR/NAME-t150.png"), (animate, "DIR/NAME-t0-t150.gif")):
        found.add_argument("folder", type=Path, metavar="DIR", help="folder of a run")
        text = "show this many layers, from the inside of a tube, from the bottom of others (default: all)"
        found.add_argument("--layers", type=int, metavar="K", help=text)
        text = "leave out the half, or the quarter, that is in front"
        found.add_argument("--cut", choices=("half", "quarter"), help=text)
        text = "front, above, or where the eye is from the middle of the body: --view=X,Y,Z (default: front)"
        found.add_argument("--view", default="front", metavar="VIEW", help=text)
        text = f"a file that does not exist yet; its ending says the kind (default: {default}, numbered when taken)"
        found.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    text = "times to show beside each other, the nearest recorded ones (default: the last)"
    picture.add_argument("--time", type=float, nargs="+", metavar="T", help=text)
    text = "recorded times to show, from 2 to 500 (default: %(default)s, or all where there are fewer)"
    animate.add_argument("--frames", type=int, default=60, metavar="N", help=text)
    revolve = command("revolve", "Write the fields of a reduced run in DIR on the whole body: fields_body.vtkhdf.")
    revolve.add_argument("folder", type=Path, metavar="DIR", help="folder of a run")
    fibres = command("export", "Write the cells of the run in DIR for other programs: a structure tensor an element.")
    fibres.add_argument("folder", type=Path, metavar="DIR", help="folder of a run")
    text = "vtu (ParaView, meshio), febio (.feb), abaqus (.inp, CalculiX too) or csv"
    fibres.add_argument("--format", required=True, choices=("vtu", "febio", "abaqus", "csv"), help=text)
    text = "a file that does not exist yet (default: fibres in DIR, with the format's ending)"
    fibres.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    fibres.add_argument("--time", type=float, metavar="T", help="a recorded time (default: the last)")
    scene_command("validate", "Check a scene without running it.")
    axes = scene_command("axes", "Write the local axes of a scene's body, before any solve, as a VTU file.")
    text = "a file that does not exist yet (default: NAME-axes.vtu)"
    axes.add_argument("-o", "--output", type=Path, metavar="FILE", help=text)
    unload = scene_command("unload", "Find the unloaded body of a scene whose geometry is the loaded one.")
    text = "folder for its scene and mesh, which does not exist yet (default: NAME-unloaded)"
    unload.add_argument("-o", "--output", type=Path, metavar="FOLDER", help=text)
    new = command("new", "Print a scene of a preset.")
    new.add_argument("preset", metavar="PRESET", help=", ".join(PRESETS))
    new.add_argument("--shape", default="tube", help="cube, tendon or tube (default: tube)")
    schema = command("schema", "Print the JSON Schema of scenes, with which an editor completes and checks keys.")
    schema.add_argument("-o", "--output", type=Path, metavar="FILE", help="new file for it (default: print it)")
    text = "Draw the paper's figures from own runs, each with its data as CSV; runs still valid are used again."
    figures = commands.add_parser("figures", help="Draw the paper's figures.", description=text)
    figures.add_argument("names", nargs="*", metavar="NAME", help="fig1, fig5 to fig11, rate, energy (default: all)")
    writes(figures, "folder for the figures (default: figures)")
    figures.add_argument("--runs", type=Path, metavar="DIR", help="recorded runs (default: results/figures-cache)")
    text = "png, pdf or svg, or several with commas between; may be repeated (default: png)"
    figures.add_argument("--format", action="append", default=[], metavar="FORMAT", help=text)
    figures.add_argument("--stamp", action="store_true", help="show in each picture what it was made with")
    figures.add_argument("--jobs", type=int, metavar="N", help="runs at a time (default: as many as there are cores)")
    commands.add_parser(SERVE)  # of the processes of a study; not listed
    command("info", "Print versions, solvers and BLAS.")
    return main_parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, one of `EXIT_CODES`."""
    with interrupts.ending_at_once():
        options = _parsed(arguments)
        try:
            kernels()  # not after minutes, when they are asked for
        except ValueError as error:
            return _fail(str(error), BAD_INPUT)
        try:
            code = COMMANDS[options.command](options)
            sys.stdout.flush()
            return code
        except SceneError as error:
            return _fail(str(error), BAD_INPUT)
        except _UnusableEnvironment as error:
            return _fail(f"the environment is not usable: {error}; run through ./with-fenicsx", BAD_ENVIRONMENT)
        except OSError as error:  # all others are caught where files are written
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python will flush once more
            if isinstance(error, BrokenPipeError):  # whoever read the output has seen enough
                return 0
            return _fail(f"cannot write to the standard output: {error.strerror}", BAD_ENVIRONMENT)


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options; of several ranks only the first says what is wrong with them."""
    with contextlib.ExitStack() as stack:
        if not interrupts.is_first_rank():
            silence = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(silence))
            stack.enter_context(contextlib.redirect_stderr(silence))
        return parser().parse_args(arguments)


def _rank() -> int:
    try:
        from mpi4py import MPI
    except ImportError:  # then there is one process, and what is missing is about to be said
        return 0
    return MPI.COMM_WORLD.rank


def _say(text: str) -> None:
    if _rank() == 0:
        print(text)


def _complain(message: str) -> None:
    with contextlib.suppress(OSError):  # nobody is there to read it
        print(f"remodel-fenicsx: {printable(message)}", file=sys.stderr, flush=True)


def _fail(message: str, code: int) -> int:
    if _rank() == 0:
        _complain(message)
    return code


def _run(options: argparse.Namespace, task: Callable[..., Path] | None = None) -> int:
    deadline = None if options.max_wall_time is None else clock.monotonic() + options.max_wall_time
    scene = None if options.resume else read_scene(options.scene, options.set, options.profile)
    wishes: Any = {"quiet": options.quiet, "deadline": deadline, "report": options.report}
    if options.resume and (options.output or options.profile):
        return _fail(f"{'-o' if options.output else '--profile'}: a run goes on in its own folder, as it is", BAD_INPUT)
    _check(reason_unusable())
    interrupts.take_back_signals()
    from remodel_fenicsx.body import GeometryError
    from remodel_fenicsx.results.checkpoint_file import CheckpointError
    from remodel_fenicsx.results.recording import RecordingError
    from remodel_fenicsx.results.run_folder import FolderTaken
    from remodel_fenicsx.running import resume, run
    from remodel_fenicsx.solver.continuation import StepFailure
    from remodel_fenicsx.unloading import NoUnloadedShape

    try:
        if scene is None:
            folder = resume(options.resume, options.set, **wishes)
        elif task is not None:
            folder = task(scene, options.output, quiet=options.quiet)
        else:
            folder = run(scene, options.output, **wishes)
    except (FolderTaken, SceneError, GeometryError, CheckpointError, RecordingError) as error:
        return _fail(" ".join(str(error).split()), BAD_INPUT)
    except NoUnloadedShape as failure:
        return _fail(str(failure), SOLVE_FAILED)
    except StepFailure as failure:
        way = "" if task is not None else ", and run --resume goes on from there"
        return _fail(f"{failure}. {failure.refusal}; every finished step is kept{way}", SOLVE_FAILED)
    except interrupts.Paused as pause:
        way = f"it goes on with: remodel-fenicsx run --resume {shlex.quote(str(pause.folder))}"
        return _fail(f"{pause}: all is kept up to time {pause.time:g}; {way}", STOPPED)
    except interrupts.Interrupted as interruption:
        end = _fail if interruption.on_all_ranks else _end_all
        return end(f"stopped by {interruption}; {interruption.kept}", interruption.exit_code)
    except OSError as error:
        if options.output and isinstance(error, (FileExistsError, NotADirectoryError)):  # lies in a file, or just taken
            text = f"-o {options.output}: {error.filename}: {error.strerror}; allowed is a new or an empty folder"
            return _end_all(text, BAD_INPUT)
        if isinstance(error, ForeignFileError):
            return _end_all(f"{error.filename}: {error.strerror}", BAD_INPUT)
        return _end_all(f"cannot write the results: {error}", BAD_ENVIRONMENT)
    except Exception:
        traceback.print_exc()
        return _end_all("stopped by a defect of the program, see above", 1)
    _say(f"results in {folder}")
    return 0


def _stability(options: argparse.Namespace) -> int:
    _check(reason_undrawable())

    def analyse(scene: Scene, folder: Path | None, quiet: bool) -> Path:
        from remodel_fenicsx.studies.stability import in_words, stability

        place, table, unseen = stability(scene, folder, options.times, quiet=quiet)
        _say(in_words(table, unseen))
        return place

    return _run(options, analyse)


def _study(options: argparse.Namespace, task: Callable[[Scene], tuple[Path, str, dict[str, str]]]) -> int:
    """Several runs that answer one question: `task` makes the folder, the answer in words, and what has failed."""
    scene = read_scene(options.scene, options.set, options.profile)
    _check(reason_unusable() or reason_undrawable())
    from remodel_fenicsx.studies.page import FigureError
    from remodel_fenicsx.studies.runs import TooFewRuns

    try:
        with interrupts.StopRequest(), interrupts.stopping_at_once():
            folder, words, failed = task(scene)
    except TooFewRuns as early:
        _complain_of(early.failed)
        return _fail(str(early), SOLVE_FAILED if early.failed else STOPPED)
    except FigureError as refusal:  # a picture or a table of somebody else's stands in its place
        return _fail(str(refusal), refusal.exit_code)
    except interrupts.Interrupted as interruption:
        return _fail(STUDY_STOPPED, interruption.exit_code)
    except ForeignFileError as error:
        return _fail(f"{error.filename}: {error.strerror}", BAD_INPUT)
    except OSError as error:
        return _fail(f"cannot write the results: {error}", BAD_ENVIRONMENT)
    _say(words)
    _say(f"results in {folder}")
    _complain_of(failed)
    return SOLVE_FAILED if failed else 0


def _complain_of(failed: Mapping[str, str]) -> None:
    for name, last_words in failed.items():
        _complain(f"{name} has failed: {last_words}")


def _ensemble(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, str, dict[str, str]]:
        from remodel_fenicsx.studies import ensemble as study

        if options.seeds < 2:
            raise SceneError(f"--seeds {options.seeds}: allowed is a whole number at least 2")
        folder, found = study.ensemble(scene, options.output, options.seeds, options.jobs, options.quiet)
        return folder, study.in_words(found, study.chosen_times(scene)), found.failed

    return _study(options, task)


def _trade(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, str, dict[str, str]]:
        from remodel_fenicsx.studies import trade as study

        say = None if options.quiet else _say
        folder, found = study.trade(scene, options.output, options.budget, options.jobs, say)
        return folder, study.in_words(found), found.failed

    return _study(options, task)


def _sweep(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, str, dict[str, str]]:
        from remodel_fenicsx.studies import sweep as study

        axes: dict[str, Any] = {}
        for text in options.axes:
            key, numbers = study.read_axis(text, options.latin)
            if key in axes:
                raise SceneError(f"sweep {key}: is there twice")
            axes[key] = numbers
        if math.prod(map(len, axes.values())) > MOST_RUNS:
            raise SceneError(f"sweep: {math.prod(map(len, axes.values()))} runs; allowed are at most {MOST_RUNS}")
        sampled = options.latin is not None
        points = study.latin_hypercube(axes, options.latin, options.seed) if sampled else study.grid(axes)
        folder, found = study.sweep(scene, points, options.output, options.jobs, options.quiet)
        return folder, study.in_words(found, scene), found.failed

    return _study(options, task)


def _fit(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, str, dict[str, str]]:
        from remodel_fenicsx.results.run_folder import FolderTaken
        from remodel_fenicsx.solver.continuation import StepFailure
        from remodel_fenicsx.studies import fit as study

        try:
            folder, found = study.fit(
                scene, options.data, options.output, options.starts, options.quiet, options.profiles
            )
        except FolderTaken as error:
            raise SceneError(" ".join(str(error).split())) from error
        except StepFailure as failure:
            raise _NoStart(f"at the start of the fit {failure}. {failure.refusal}; choose other starts") from failure
        return folder, study.in_words(found), {}

    try:
        return _study(options, task)
    except _NoStart as failure:
        return _fail(str(failure), SOLVE_FAILED)


class _NoStart(Exception):  # noqa: N818
    """A fit starts where the scene has no equilibrium."""


def _end_all(message: str, code: int) -> int:
    """End the run on all ranks: an error on one of them leaves the others waiting for ever."""
    from mpi4py import MPI

    _complain(message)
    if MPI.COMM_WORLD.size > 1:
        MPI.COMM_WORLD.Abort(code)
    return code


def _status(options: argparse.Namespace) -> int:
    from remodel_fenicsx.results.checkpoint_file import CheckpointError
    from remodel_fenicsx.results.recording import RecordingError
    from remodel_fenicsx.results.status import status

    try:
        lines = status(options.folder)
    except (RecordingError, CheckpointError) as error:
        return _fail(str(error), BAD_INPUT)
    except ForeignFileError as error:
        return _fail(f"{error.filename}: {error.strerror}", BAD_INPUT)
    except OSError as error:
        return _fail(f"{options.folder}: cannot be read: {error.strerror}", BAD_ENVIRONMENT)
    _say("\n".join(map(printable, lines)))
    return 0


def _report(options: argparse.Namespace) -> int:
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.report import ReportError, write_report
    from remodel_fenicsx.results.recording import RecordingError

    try:
        written = write_report(options.folder, options.output, options.size)
    except (RecordingError, ReportError) as error:
        return _fail(str(error), BAD_INPUT)
    except ForeignFileError as error:
        return _fail(f"{error.filename}: {error.strerror}", BAD_INPUT)
    except OSError as error:
        return _fail(f"cannot write the report: {error}", BAD_ENVIRONMENT)
    _say(str(written))
    size = written.stat().st_size / 1e6
    if size > options.size:
        _complain(f"warning: it has {size:.3g} MB, more than --size {options.size:g}: two times of this body need that")
    if options.open:
        import webbrowser  # slow to import, and seldom asked for

        if not webbrowser.open(written.resolve().as_uri()):
            _complain(f"warning: no browser is to be found from here; open {written} in yours")
    return 0


def _drawing(options: argparse.Namespace) -> int:
    """A picture or an animation."""
    _check(reason_undrawable())
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.pictures.files import draw_animation, draw_picture
    from remodel_fenicsx.pictures.sight import Viewing
    from remodel_fenicsx.results.recording import RecordingError
    from remodel_fenicsx.studies.page import FigureError

    viewing = Viewing(options.layers, options.cut, options.view)
    try:
        if options.command == "picture":
            written = draw_picture(options.folder, options.time, viewing, options.output)
        else:
            written = draw_animation(options.folder, options.frames, viewing, options.output)
    except FigureError as refusal:
        return _fail(str(refusal), refusal.exit_code)
    except RecordingError as error:
        return _fail(str(error), BAD_INPUT)
    except ForeignFileError as error:
        return _fail(f"{error.filename}: {error.strerror}", BAD_INPUT)
    except OSError as error:
        return _fail(f"cannot write the picture: {error}", BAD_ENVIRONMENT)
    _say(str(written))
    return 0


def _revolve(options: argparse.Namespace) -> int:
    _check(reason_unusable())
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.results.recording import RecordingError
    from remodel_fenicsx.results.revolve import revolve

    try:
        written = revolve(options.folder)
    except RecordingError as error:
        return _fail(str(error), BAD_INPUT)
    except OSError as error:
        return _fail(f"cannot write the fields: {error}", BAD_ENVIRONMENT)
    _say("\n".join(map(str, written)))
    return 0


def _export(options: argparse.Namespace) -> int:
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.results.export import export
    from remodel_fenicsx.results.recording import RecordingError

    try:
        written = export(options.folder, options.format, options.output, options.time)
    except RecordingError as error:
        return _fail(str(error), BAD_INPUT)
    except OSError as error:
        return _fail(f"cannot write the fibres: {error}", BAD_ENVIRONMENT)
    _say(str(written))
    return 0


def _validate(options: argparse.Namespace) -> int:
    scene = read_scene(options.scene, options.set, options.profile)
    _say(f"{options.scene}: a valid scene ({scene.geometry.name}, {scene.time.in_words()})")
    _say(scene.summary())
    _say("\n".join(explained(scene)))
    if scene.profile is not None:
        _say(PROFILES[scene.profile].in_words(scene.profile))
    if _rank() == 0:
        for warning in scene.warnings():
            _complain(f"warning: {warning}")
    return 0


def _axes(options: argparse.Namespace) -> int:
    scene = read_scene(options.scene, options.set, options.profile)
    _check(reason_unusable())
    from remodel_fenicsx.studies.preview import write_axes

    path = options.output or Path(f"{scene.name}-axes.vtu")
    return _written(lambda: write_axes(scene, path), path, "file", f"local axes in {path}")


def _unload(options: argparse.Namespace) -> int:
    scene = read_scene(options.scene, options.set, options.profile)
    if not scene.geometry.is_loaded:
        return _fail("geometry.is = 'unloaded': nothing to find; allowed is 'loaded'", BAD_INPUT)
    _check(reason_unusable())
    from remodel_fenicsx.studies.unloaded_folder import write_unloaded
    from remodel_fenicsx.unloading import NoUnloadedShape

    place = options.output or Path(f"{scene.name}-unloaded")
    said = f"scene of the unloaded body in {place / 'scene.toml'}"
    try:
        return _written(lambda: write_unloaded(scene, place), place, "folder", said)
    except NoUnloadedShape as failure:
        return _fail(str(failure), SOLVE_FAILED)


def _written(write: Callable[[], str], place: Path, kind: str, said: str) -> int:
    """Say what write() found and where it is, or why there is nothing; `place` must be new, a `kind`."""
    from remodel_fenicsx.body import GeometryError

    try:
        with interrupts.StopRequest(), interrupts.stopping_at_once():
            words = write()
    except (SceneError, GeometryError) as error:
        return _fail(" ".join(str(error).split()), BAD_INPUT)
    except interrupts.Interrupted as interruption:
        return _fail(f"stopped by {interruption}", interruption.exit_code)
    except FileExistsError:
        return _end_all(f"-o {place}: exists; allowed is a {kind} that does not", BAD_INPUT)
    except OSError as error:
        return _end_all(f"-o {place}: cannot be written: {error.strerror}", BAD_ENVIRONMENT)
    _say(f"{words}\n{said}")
    return 0


def _new(options: argparse.Namespace) -> int:
    scene: Scene = preset_scene(options.preset, options.shape)
    _say(scene.to_toml(f"a scene of the preset {options.preset}").rstrip("\n"))
    return 0


def _schema(options: argparse.Namespace) -> int:
    from remodel_fenicsx.scene.json_schema import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
    if options.output is None:
        _say(text)
        return 0
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    try:
        write_new(options.output, f"{text}\n".encode())
    except FileExistsError:
        return _fail(f"-o {options.output}: exists; allowed is a file that does not", BAD_INPUT)
    except OSError as error:
        return _fail(f"-o {options.output}: cannot be written: {error.strerror}", BAD_ENVIRONMENT)
    _say(f"JSON Schema in {options.output}")
    return 0


def _figures(options: argparse.Namespace) -> int:
    try:
        from remodel_fenicsx import paper as figures
    except ImportError as error:
        raise _UnusableEnvironment(error) from error
    folder, runs = options.output or figures.DEFAULT_FOLDER, options.runs or figures.DEFAULT_RUNS
    try:
        formats = [name for text in options.format for name in text.split(",")] or ["png"]
        with interrupts.StopRequest(), interrupts.stopping_at_once():
            written = figures.draw(options.names, folder, runs, options.jobs, formats, options.stamp)
    except figures.FigureError as error:
        return _fail(str(error), error.exit_code)
    except interrupts.Interrupted as interruption:
        return _fail(STUDY_STOPPED, interruption.exit_code)
    except OSError as error:
        return _fail(f"cannot write the figures: {error}", BAD_ENVIRONMENT)
    print("\n".join(map(str, written)))
    return 0


def _info(options: argparse.Namespace) -> int:
    _check(reason_unusable())
    from remodel_fenicsx.fem.jit import has_simd_logarithm
    from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS

    for name, version in versions().items():
        _say(f"{name:16} {version}")
    _say(f"{'logarithms':16} {'of several points at once' if has_simd_logarithm() else 'point by point'}")
    _say(f"{'solver methods':16} {', '.join(SOLVER_METHODS)}")
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": _run,
    "stability": _stability,
    "ensemble": _ensemble,
    "trade": _trade,
    "sweep": _sweep,
    "fit": _fit,
    "status": _status,
    "report": _report,
    "picture": _drawing,
    "animate": _drawing,
    "revolve": _revolve,
    "export": _export,
    "validate": _validate,
    "axes": _axes,
    "unload": _unload,
    "new": _new,
    "schema": _schema,
    "figures": _figures,
    "info": _info,
    SERVE: lambda options: serve(main),
}


if __name__ == "__main__":
    sys.exit(main())
