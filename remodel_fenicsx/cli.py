"""The command remodel-fenicsx: thin, no numerics."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import sys
import time as clock
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from remodel_fenicsx._version import __version__
from remodel_fenicsx.body.reductions import explained
from remodel_fenicsx.errors import BAD_ENVIRONMENT, BAD_INPUT, PAUSED, RemodelError, SOLVE_FAILED
from remodel_fenicsx.scene.presets import PRESETS, PROFILES, profile_for
from remodel_fenicsx.scene.scene import Scene, preset_scene, read_scene
from remodel_fenicsx.schema.tables import printable, shortened
from remodel_fenicsx.system import interrupts
from remodel_fenicsx.system.extensions import EXTENSIONS, load_extensions
from remodel_fenicsx.system.files import (
    megabytes,
    positive,
    refusal_in_words,
    wall_time,
    write_new,
)
from remodel_fenicsx.system.children import SERVE, serve
from remodel_fenicsx.system.environment import check_usable, kernels, reason_undrawable, reason_unusable, versions

OPTIONS = {"folder": "-o", "path": "-o", "times": "--time", "layers": "--layers", "cut": "--cut", "view": "--view"}
EXIT_CODES = {
    0: "finished",
    BAD_INPUT: "bad input",
    SOLVE_FAILED: "the solve failed",
    PAUSED: "stopped on purpose",
    BAD_ENVIRONMENT: "environment not usable",
    129: "hung up",
    130: "interrupted",
    143: "terminated",
}


class _Parser(argparse.ArgumentParser):
    """What it complains of stays on one line, control characters and all."""

    def error(self, message: str) -> NoReturn:
        super().error(shortened(printable(message)))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    main_parser = _Parser(
        prog="remodel-fenicsx",
        description="Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007).",
        epilog=MAIN_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_extensions(main_parser)
    main_parser.add_argument("--version", action="version", version=__version__, help="Print the version and end.")
    commands = _Commands(main_parser.add_subparsers(dest="command", required=True, metavar="COMMAND"))
    _add_runs(commands)
    _add_views(commands)
    _add_preparations(commands)
    _add_studies(commands)
    commands.found.add_parser(SERVE)  # of the processes of a study; not listed
    commands.add("info", "Print the versions of the program and its libraries, the solvers and the BLAS.", "info")
    return main_parser


def _extensions_parser() -> argparse.ArgumentParser:
    """Of what may stand anywhere, and is done before the rest is looked at."""
    found = _Parser(prog="remodel-fenicsx", add_help=False, allow_abbrev=False)
    _add_extensions(found)
    return found


def _add_extensions(found: argparse.ArgumentParser) -> None:
    text = f"Run this Python file first, whose parts scenes may then name; anywhere, repeatable (or {EXTENSIONS})."
    found.add_argument("--with", action="append", dest="extensions", metavar="FILE.py", help=text)


MAIN_EPILOG = (
    "examples:\n"
    "  remodel-fenicsx new kuhl-holzapfel-2007 > artery.toml\n"
    "  remodel-fenicsx run artery.toml -o artery\n"
    "  remodel-fenicsx report artery --open\n\n"
    "'remodel-fenicsx COMMAND --help' explains a command; docs/commands.md explains all.\n\n"
    "exit codes:\n" + "\n".join(f"  {code:<5}{meaning}" for code, meaning in EXIT_CODES.items())
)


class _Commands:
    """The commands of a parser. Each says what it is for, and ends its help with examples."""

    def __init__(self, found: Any) -> None:
        self.found = found

    def add(self, name: str, text: str, *examples: str) -> argparse.ArgumentParser:
        """One more; an example is what follows the program's name."""
        shown = "\n".join(f"  remodel-fenicsx {example}" for example in examples)
        epilog = f"{'examples' if len(examples) > 1 else 'example'}:\n{shown}"
        raw = argparse.RawDescriptionHelpFormatter
        added: argparse.ArgumentParser = self.found.add_parser(
            name, help=text.replace("%", "%%"), description=text, epilog=epilog, formatter_class=raw
        )
        _add_extensions(added)
        return added

    def add_for_scene(self, name: str, text: str, *examples: str) -> argparse.ArgumentParser:
        """One that reads a scene, which `run --resume` finds in the folder."""
        found, meaning = self.add(name, text, *examples), "The scene file (TOML); docs/scene.md lists its keys."
        if name == "run":
            which = found.add_mutually_exclusive_group(required=True)
            which.add_argument("scene", type=Path, nargs="?", metavar="SCENE", help=meaning)
            text = "Go on with the run in DIR from its last checkpoint, in place of a new run of SCENE."
            which.add_argument("--resume", type=Path, metavar="DIR", help=text)
        else:
            found.add_argument("scene", type=Path, metavar="SCENE", help=meaning)
        text = "Change one key of the scene, such as cells.seed=2 or time.end=10. May be repeated."
        found.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=text)
        text = "Choose speed or accuracy: mesh, step and element of a measured profile replace those of the scene."
        found.add_argument("--profile", choices=PROFILES, help=text)
        return found

    def add_for_run(self, name: str, text: str, *examples: str) -> argparse.ArgumentParser:
        """One that reads the folder of a run."""
        found = self.add(name, text, *examples)
        found.add_argument("folder", type=Path, metavar="DIR", help="The folder of a run.")
        return found


def _writes(found: argparse.ArgumentParser, text: str, metavar: str = "DIR") -> None:
    found.add_argument("-o", "--output", type=Path, metavar=metavar, help=text)


def _quiet(found: argparse.ArgumentParser) -> None:
    found.add_argument("-q", "--quiet", action="store_true", help="Show no progress, only warnings.")


def _jobs(found: argparse.ArgumentParser, kind: Callable[[str], int] = positive) -> None:
    text = "Do at most N runs at a time (default: as many as there are cores)."
    found.add_argument("--jobs", type=kind, metavar="N", help=text)


def _add_runs(commands: _Commands) -> None:
    """Those that solve a scene once, or say where that is."""
    run_command = commands.add_for_scene(
        "run",
        "Solve a scene, or go on with a run that was stopped.",
        "run artery.toml -o artery",
        "run artery.toml --set time.end=10 -o short",
        "run --resume artery --set time.end=300",
        "run artery.toml --max-wall-time 2h",
    )
    _writes(run_command, "Put the results into this folder, which must be new or empty (default: results/NAME).")
    text = "Stop before this time is over (90s, 30min, 2h, 1.5d): after a whole step, with exit code 4."
    run_command.add_argument("--max-wall-time", type=wall_time, metavar="TIME", help=text)
    text = "Make no report.html at the end, as with output.report = false."
    run_command.add_argument("--no-report", dest="report", action="store_false", help=text)
    _quiet(run_command)
    text = "Say where the run in DIR is, how fast it is, and whether it is alive."
    commands.add_for_run("status", text, "status artery")


def _add_views(commands: _Commands) -> None:
    """Those that show a run, or write it for other programs."""
    text = "Make the page of the run in DIR for a browser, finished or not."
    report = commands.add_for_run("report", text, "report artery --open", "report artery -o artery.html --size 5")
    _writes(report, "Write the page to this new file (default: DIR/report.html, which is made anew).", "FILE")
    text = "Limit the page to this many MB (default: %(default)g); where it would be larger it shows fewer times."
    report.add_argument("--size", type=megabytes, default=20.0, metavar="MB", help=text)
    report.add_argument("--open", action="store_true", help="Show the page in a browser.")
    picture = commands.add_for_run(
        "picture",
        "Draw the body of the run in DIR: PNG, SVG or PDF.",
        "picture artery --time 0 25 150 --cut half",
        "picture artery --layers 3 --view above -o wall.pdf",
    )
    animate = commands.add_for_run(
        "animate",
        "Draw the body of the run in DIR as it moves: GIF, WebP, or MP4 with ffmpeg.",
        "animate artery -o artery.webp --frames 40",
    )
    for found, default in ((picture, "DIR/NAME-t150.png"), (animate, "DIR/NAME-t0-t150.gif")):
        text = "Show this many layers: of a tube from the inside, of others from the bottom (default: all)."
        found.add_argument("--layers", type=int, metavar="K", help=text)
        text = "Leave out the half in front of the middle, or only the quarter in front and to the right."
        found.add_argument("--cut", choices=("half", "quarter"), help=text)
        text = (
            "Look from the front or from above, or from X,Y,Z as seen from the middle: --view=X,Y,Z (default: front)."
        )
        found.add_argument("--view", default="front", metavar="VIEW", help=text)
        text = f"Write to this new file, whose ending says the kind (default: {default}, numbered when taken)."
        _writes(found, text, "FILE")
    text = "Show these times beside each other, each the nearest recorded one (default: the last)."
    picture.add_argument("--time", type=float, nargs="+", metavar="T", help=text)
    text = "Show this many recorded times, from 2 to 500 (default: %(default)s, or all where there are fewer)."
    animate.add_argument("--frames", type=int, default=60, metavar="N", help=text)
    text = "Write the fields of a reduced run in DIR on the whole body, for ParaView."
    commands.add_for_run("revolve", text, "revolve artery")
    text = "Write the fibres of the run in DIR for FEBio, Abaqus, ParaView or as a table."
    fibres = commands.add_for_run("export", text, "export artery --format febio -o fibres.feb")
    text = "Write vtu (ParaView, meshio), febio (.feb), abaqus (.inp, CalculiX too) or csv."
    fibres.add_argument("--format", required=True, choices=("vtu", "febio", "abaqus", "csv"), help=text)
    _writes(fibres, "Write to this new file (default: fibres in DIR, with the ending of the format).", "FILE")
    fibres.add_argument("--time", type=float, metavar="T", help="Take this recorded time (default: the last).")


def _add_preparations(commands: _Commands) -> None:
    """Those that make or look at a scene before it is run."""
    new = commands.add(
        "new", "Print a scene of a published model, with every key.", "new kuhl-holzapfel-2007 --shape tube > mine.toml"
    )
    new.add_argument("preset", metavar="PRESET", help=f"The model: {', '.join(PRESETS)}.")
    new.add_argument("--shape", default="tube", help="The body: cube, tendon or tube (default: tube).")
    text = "Check a scene without running it, and show what it means."
    commands.add_for_scene("validate", text, "validate artery.toml", "validate artery.toml --profile fast")
    text = "Write the local axes of a scene's body as a VTU file, before any solve."
    axes = commands.add_for_scene("axes", text, "axes artery.toml -o artery-axes.vtu")
    _writes(axes, "Write to this new file (default: NAME-axes.vtu).", "FILE")
    text = "Find the unloaded body of a scene whose geometry is the loaded one."
    unload = commands.add_for_scene("unload", text, "unload scanned.toml -o unloaded")
    _writes(unload, "Put its scene and mesh into this new folder (default: NAME-unloaded).", "FOLDER")
    text = "Print the JSON Schema of scenes, with which an editor completes and checks keys."
    schema = commands.add("schema", text, "schema -o scene.schema.json")
    _writes(schema, "Write it to this new file (default: print it).", "FILE")


def _add_studies(commands: _Commands) -> None:
    """Those that run a scene several times, or look at it more closely."""
    sweep = commands.add_for_scene(
        "sweep",
        "Run a scene with other numbers, and show how its end depends on them.",
        "sweep mine.toml loads.pressure.value=2:6:5",
        "sweep mine.toml loads.pressure.value=2:6:5 remodeling.kappa=0.02,0.05",
        "sweep mine.toml loads.pressure.value=2:6 material.lame_mu=10:40 --latin 20",
    )
    text = "Vary a key: KEY=a:b:n takes n numbers from a to b, KEY=a,b,... these. Several keys are combined."
    sweep.add_argument("axes", nargs="+", metavar="KEY=a:b:n", help=text)
    text = "Take N points of a Latin hypercube in place of all combinations. Each key is then KEY=a:b."
    sweep.add_argument("--latin", type=positive, metavar="N", help=text)
    text = "Draw the Latin hypercube from this seed (default: 1)."
    sweep.add_argument("--seed", type=int, default=1, metavar="N", help=text)
    text = "Run a scene of random cells with many seeds, and with isotropic cells."
    ensemble = commands.add_for_scene("ensemble", text, "ensemble artery.toml --seeds 32 -o seeds")
    text = "Use this many seeds (default: 32; at least 2)."
    ensemble.add_argument("--seeds", type=positive, default=32, metavar="N", help=text)
    text = "Run a scene with coarse and fine settings: what each costs, and how far off it is."
    trade = commands.add_for_scene("trade", text, "trade artery.toml --budget 10min")
    text = "Begin no run that would end after this wall time: 90s, 10min, 2h (default: 10min). Cheap runs come first."
    trade.add_argument("--budget", type=wall_time, default=600.0, metavar="TIME", help=text)
    for study, name in ((sweep, "sweep"), (ensemble, "ensemble"), (trade, "trade")):
        text = "The same command goes on there: finished runs are used again."
        _writes(study, f"Put the results into this folder (default: results/NAME-{name}). {text}")
        _jobs(study)
        _quiet(study)
    _add_fit(commands)
    text = "Run a scene and say whether its remodeling passes damp small errors or amplify them."
    stability = commands.add_for_scene("stability", text, "stability artery.toml --times 5 -o stable")
    _writes(stability, "Put the results into this new or empty folder (default: results/NAME-stability).")
    text = "Look at N times of the run (default: 10)."
    stability.add_argument("--times", type=positive, default=10, metavar="N", help=text)
    stability.set_defaults(resume=None, max_wall_time=None, report=False)
    _quiet(stability)


def _add_fit(commands: _Commands) -> None:
    text = "Find numbers of a scene from measurements, with 95 % bands."
    fitting = commands.add_for_scene("fit", text, "fit tube.toml inflation.toml -o fitted")
    text = "A TOML file with the unknowns and the tables of measurements; docs/fit.md explains it."
    fitting.add_argument("data", type=Path, metavar="DATA", help=text)
    text = "A folder of the same fit goes on."
    _writes(fitting, f"Put the results into this new or empty folder (default: results/NAME-fit). {text}")
    text = "Leave out the likelihood profiles, which are made for unknowns that depend on each other."
    fitting.add_argument("--no-likelihood-profiles", dest="profiles", action="store_false", help=text)
    text = "Start from N points: the given one, and others within a factor of two (default: 3)."
    fitting.add_argument("--starts", type=positive, default=3, metavar="N", help=text)
    _quiet(fitting)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, one of `EXIT_CODES`."""
    for stream in (0, 1, 2):  # where one is closed a file of the run would get its number, and what libraries print
        with contextlib.suppress(OSError):
            os.fstat(stream)
            continue
        os.open(os.devnull, os.O_RDWR)
    sys.stdout, sys.stderr = sys.stdout or open(os.devnull, "w"), sys.stderr or open(os.devnull, "w")
    with interrupts.ending_at_once():
        return _done(list(sys.argv[1:] if arguments is None else arguments))


def _done(arguments: list[str]) -> int:
    """Do a command; returns its exit code. What ends it is said in one line."""
    options, output = argparse.Namespace(command=None), None
    try:
        with _only_the_first_rank_speaks():
            first, rest = _extensions_parser().parse_known_args(arguments)
            load_extensions(first.extensions or ())
            if rest[:1] == ["figures"]:
                raise RemodelError("figures: is a script now: ./with-fenicsx python3 demos/figures.py fig8")
            options = parser().parse_args(arguments)
        output = getattr(options, "output", None)
        kernels()  # not after minutes, when they are asked for
        return COMMANDS[options.command](options)
    except RemodelError as error:
        return _fail(_as_typed(error, output), error.exit_code, error.on_all_ranks)
    except OSError as error:
        if output and isinstance(error, (FileExistsError, NotADirectoryError)):  # lies in a file, or just taken
            text = f"-o {output}: {error.filename}: {error.strerror}; allowed is a new or an empty folder"
            return _fail(text, BAD_INPUT, on_all_ranks=False)
        text = "cannot read the run" if options.command == "status" else "cannot write the results"
        return _fail(f"{text}: {refusal_in_words(error)}", BAD_ENVIRONMENT, on_all_ranks=False)
    except Exception:
        traceback.print_exc()
        return _fail("stopped by a defect of the program, see above", 1, on_all_ranks=False)


@contextlib.contextmanager
def _only_the_first_rank_speaks() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        if not interrupts.is_first_rank():
            silence = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(silence))
            stack.enter_context(contextlib.redirect_stderr(silence))
        yield


def _say(text: str) -> None:
    if not interrupts.is_first_rank():
        return
    try:
        print(text, flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python will flush once more
        if not isinstance(error, BrokenPipeError):  # whoever read the output has seen enough
            raise OutputError(f"cannot write to the standard output: {error.strerror}") from error


class OutputError(RemodelError):
    """What a command says cannot be written."""

    exit_code = BAD_ENVIRONMENT


def _complain(message: str) -> None:
    with contextlib.suppress(OSError):  # nobody is there to read it
        print(f"remodel-fenicsx: {shortened(printable(message))}", file=sys.stderr, flush=True)


def _fail(message: str, code: int, on_all_ranks: bool = True) -> int:
    """Say what has ended the command; an error on one of several ranks would leave the others waiting for ever."""
    if interrupts.is_first_rank() or not on_all_ranks:
        _complain(message)
    mpi = sys.modules.get("mpi4py.MPI")
    if not on_all_ranks and mpi is not None and mpi.COMM_WORLD.size > 1:
        mpi.COMM_WORLD.Abort(code)
    return code


def _as_typed(error: RemodelError, output: Path | None) -> str:
    """In one line; where it begins with an argument of Python's, that is the option which was typed."""
    line = re.sub(r"^\w+(?=[ :])", lambda name: OPTIONS.get(name[0], name[0]), error.in_words())
    return f"-o {line}" if output is not None and line.startswith(f"{output}: ") else line


def _run(options: argparse.Namespace, task: Callable[..., Path] | None = None) -> int:
    deadline = None if options.max_wall_time is None else clock.monotonic() + options.max_wall_time
    scene = None if options.resume else read_scene(options.scene, options.set, options.profile)
    wishes: Any = {"quiet": options.quiet, "deadline": deadline, "report": options.report}
    if options.resume and (options.output or options.profile):
        return _fail(
            f"{'-o' if options.output else '--profile'}: a run goes on in its own folder, with its own settings",
            BAD_INPUT,
        )
    check_usable(reason_unusable())
    interrupts.take_back_signals()
    from remodel_fenicsx.running import resume, run

    if scene is None:
        folder = resume(options.resume, options.set, **wishes)
    elif task is not None:
        folder = task(scene, options.output, quiet=options.quiet)
    else:
        folder = run(scene, options.output, **wishes)
    _say(f"results in {folder}")
    return 0


def _stability(options: argparse.Namespace) -> int:
    check_usable(reason_undrawable())

    def analyse(scene: Scene, folder: Path | None, quiet: bool) -> Path:
        from remodel_fenicsx.studies.stability import stability

        place, found = stability(scene, folder, options.times, quiet=quiet)
        _say(found.in_words())
        return place

    return _run(options, analyse)


def _study(options: argparse.Namespace, task: Callable[[Scene], tuple[Path, Any]]) -> int:
    """Several runs that answer one question: `task` makes the folder and the answer."""
    scene = read_scene(options.scene, options.set, options.profile)
    check_usable(reason_unusable() or reason_undrawable())
    from remodel_fenicsx.studies.study import TooFewRuns

    try:
        with _stopping("all that is recorded is kept, the same command goes on"):
            folder, found = task(scene)
    except TooFewRuns as early:
        _complain_of(early.failed)
        raise
    _say(found.in_words())
    _say(f"results in {folder}")
    _complain_of(found.failed)
    return SOLVE_FAILED if found.failed else 0


@contextlib.contextmanager
def _stopping(kept: str) -> Iterator[None]:
    """Within, a signal ends the command at once, which says what is kept."""
    try:
        with interrupts.StopRequest(), interrupts.stopping_at_once():
            yield
    except interrupts.Interrupted as interruption:
        interruption.kept = kept
        raise


def _complain_of(failed: Mapping[str, str]) -> None:
    for name, last_words in failed.items():
        _complain(f"{name} has failed: {last_words}")


def _ensemble(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, Any]:
        from remodel_fenicsx.studies.sweep import ensemble

        return ensemble(scene, options.output, options.seeds, options.jobs, options.quiet)

    return _study(options, task)


def _trade(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, Any]:
        from remodel_fenicsx.studies.trade import trade

        return trade(scene, options.output, options.budget, options.jobs, None if options.quiet else _say)

    return _study(options, task)


def _sweep(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, Any]:
        from remodel_fenicsx.studies import sweep as study

        is_sampled = options.latin is not None
        axes = study.read_axes(options.axes, is_sampled)
        points = study.latin_hypercube(axes, options.latin, options.seed) if is_sampled else study.grid(axes)
        return study.sweep(scene, points, options.output, options.jobs, options.quiet, is_sampled)

    return _study(options, task)


def _fit(options: argparse.Namespace) -> int:
    def task(scene: Scene) -> tuple[Path, Any]:
        from remodel_fenicsx.studies.fit import fit

        return fit(scene, options.data, options.output, options.starts, options.quiet, options.profiles)

    return _study(options, task)


def _status(options: argparse.Namespace) -> int:
    from remodel_fenicsx.results.status import status

    _say("\n".join(map(printable, status(options.folder))))
    return 0


def _report(options: argparse.Namespace) -> int:
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.report import write_report

    written = write_report(options.folder, options.output, options.size)
    _say(str(written))
    size = written.stat().st_size / 1e6
    if size > options.size:
        _complain(f"warning: the page has {size:.3g} MB, more than --size {options.size:g}: even two times need that")
    if options.open:
        import webbrowser  # slow to import, and seldom asked for

        if not webbrowser.open(written.resolve().as_uri()):
            _complain(f"warning: no browser was found; open {written} in yours")
    return 0


def _drawing(options: argparse.Namespace) -> int:
    """A picture or an animation."""
    check_usable(reason_undrawable())
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.pictures.files import draw_animation, draw_picture
    from remodel_fenicsx.pictures.bodies import Viewing

    viewing = Viewing(options.layers, options.cut, options.view)
    if options.command == "picture":
        written = draw_picture(options.folder, options.time, viewing, options.output)
    else:
        written = draw_animation(options.folder, options.frames, viewing, options.output)
    _say(str(written))
    return 0


def _revolve(options: argparse.Namespace) -> int:
    check_usable(reason_unusable())
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.results.whole_body import revolve

    _say("\n".join(map(str, revolve(options.folder))))
    return 0


def _export(options: argparse.Namespace) -> int:
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    from remodel_fenicsx.results.export import export

    _say(str(export(options.folder, options.format, options.output, options.time)))
    return 0


def _validate(options: argparse.Namespace) -> int:
    scene, unseen = read_scene(options.scene, options.set, options.profile), ""
    if interrupts.is_first_rank() and (scene.measured_cells or scene.geometry.kept_files()[1]):
        unseen = _unseen_files(scene)
    _say(f"{options.scene}: a valid scene ({scene.geometry.name}, {scene.time.in_words()})")
    _say(scene.summary())
    _say("\n".join([*explained(scene), scene.formulation_in_words()]))
    if scene.profile is not None:
        _say(profile_for(scene.profile, scene).in_words(scene.profile))
    if interrupts.is_first_rank():
        for warning in scene.warnings():
            _complain(f"warning: {warning}")
    if unseen:
        _say(f"not looked at: {unseen}")
    return 0


def _unseen_files(scene: Scene) -> str:
    """What was not looked at of the files that it names; raises `SceneError` where a run would refuse one."""
    if (reason := reason_unusable()) is not None:
        return f"the files that it names; {reason}"
    from remodel_fenicsx.simulation import check_files

    return check_files(scene)


def _axes(options: argparse.Namespace) -> int:
    scene = read_scene(options.scene, options.set, options.profile)
    check_usable(reason_unusable())
    from remodel_fenicsx.studies.preparation import write_axes

    path = options.output or Path(f"{scene.name}-axes.vtu")
    with _stopping("nothing is written"):
        words = write_axes(scene, path)
    _say(f"{words}\nlocal axes in {path}")
    return 0


def _unload(options: argparse.Namespace) -> int:
    scene = read_scene(options.scene, options.set, options.profile)
    if not scene.geometry.is_loaded:
        return _fail("geometry.is = 'unloaded': the body is unloaded already; allowed is 'loaded'", BAD_INPUT)
    check_usable(reason_unusable())
    from remodel_fenicsx.studies.preparation import write_unloaded

    place = options.output or Path(f"{scene.name}-unloaded")
    with _stopping("nothing is written"):
        words = write_unloaded(scene, place)
    _say(f"{words}\nscene of the unloaded body in {place / 'scene.toml'}")
    return 0


def _new(options: argparse.Namespace) -> int:
    scene: Scene = preset_scene(options.preset, options.shape)
    _say(scene.to_toml(f"a scene of the preset {options.preset}").rstrip("\n"))
    return 0


def _schema(options: argparse.Namespace) -> int:
    from remodel_fenicsx.scene.reference import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
    if options.output is None:
        _say(text)
        return 0
    if not interrupts.is_first_rank():  # the work of one process
        return 0
    write_new(options.output, f"{text}\n".encode())
    _say(f"JSON Schema in {options.output}")
    return 0


def _info(options: argparse.Namespace) -> int:
    check_usable(reason_unusable())
    from remodel_fenicsx.fem.jit import has_simd_logarithm
    from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS
    from remodel_fenicsx.kernels import is_available

    for name, version in versions().items():
        _say(f"{name:16} {version}")
    _say(f"{'logarithms':16} {'of several points at once' if has_simd_logarithm() else 'point by point'}")
    _say(f"{'kept factors':16} in {'single' if is_available() else 'double'} precision")
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
    "info": _info,
    SERVE: lambda options: serve(main),
}


if __name__ == "__main__":
    sys.exit(main())
