"""The command line: arguments, exit codes and output of all commands; no numerics."""

from __future__ import annotations

import argparse
import contextlib
import errno
import inspect
import json
import os
import re
import sys
import time as clock
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from remodel_fenicsx._lazy import Late
from remodel_fenicsx._version import __version__
from remodel_fenicsx.errors import (
    BAD_ENVIRONMENT,
    BAD_INPUT,
    PAUSED,
    RemodelError,
    SOLVE_FAILED,
    printable,
    shortened,
)
from remodel_fenicsx.system import interrupts
from remodel_fenicsx.system.children import PART, SERVE, serve
from remodel_fenicsx.system.environment import (
    EXTENSIONS,
    blamed,
    check_usable,
    kernels,
    load_extensions,
    environment_problem,
    versions,
)
from remodel_fenicsx.system.files import positive, refusal_in_words, wall_time, write_new

if TYPE_CHECKING:
    from remodel_fenicsx.studies.study import StudyResult
    from remodel_fenicsx.scene.scene import Scene

# No help text needs these modules.
presets, scenes = Late("remodel_fenicsx.scene.presets"), Late("remodel_fenicsx.scene.scene")

EXIT_CODES = {
    0: "finished",
    BAD_INPUT: "invalid input",
    SOLVE_FAILED: "solve failed",
    PAUSED: "stopped on request",
    BAD_ENVIRONMENT: "environment not usable",
    129: "hangup (SIGHUP)",
    130: "interrupted (SIGINT)",
    143: "terminated (SIGTERM)",
}
MAIN_EPILOG = (
    "examples:\n"
    "  remodel-fenicsx new kuhl-holzapfel-2007 > artery.toml\n"
    "  remodel-fenicsx run artery.toml -o artery\n"
    "  remodel-fenicsx report artery --open\n\n"
    "'remodel-fenicsx COMMAND --help' explains a command; docs/commands.md explains all.\n\n"
    "exit codes:\n" + "\n".join(f"  {code:<5}{meaning}" for code, meaning in EXIT_CODES.items())
)


# ---------------------------------------------------------------- definition and end of a command
Do = Callable[[argparse.Namespace], int | None]
Needs = Sequence[Callable[[], str | None]]
TYPE_OF_METAVAR: dict[str, Callable[[str], object]] = {
    **dict.fromkeys(("DATA", "DIR", "FILE", "FOLDER", "SCENE"), Path),
    **{"K": int, "LENGTH": float, "N": positive, "SEED": int, "T": float, "TIME": wall_time},
}
# marks behind values: required, optional, one or more, may be repeated
MARKS: dict[str, dict[str, Any]] = {
    "": {},
    "!": {"required": True},
    "?": {"nargs": "?"},
    "+": {"nargs": "+"},
    "*": {"action": "append", "default": []},
}


class Command(NamedTuple):
    """A command: function, example arguments, option blocks and requirements."""

    function: Do
    example: str
    usage: Sequence[str]
    needs: Needs
    alone: bool


COMMANDS: dict[str, Command] = {}  # by name, in the order of the help


def command(
    example: str, *usage: str, needs: Needs = (), alone: bool = False
) -> Callable[[Do], Do]:
    """Make a decorator that registers a function as a command; its docstring is the help text."""

    # The function receives the options, with `scene` if the command takes a scene file, and returns
    # an exit code or None for 0. It runs only if all requirements are met. With `alone`, only the
    # first of several ranks runs it.
    def listed(do: Do) -> Do:
        COMMANDS[example.partition(" ")[0]] = Command(do, example, usage, needs, alone)
        return do

    return listed


class _Parser(argparse.ArgumentParser):
    """Parser with errors on one line, without control characters."""

    def error(self, message: str) -> NoReturn:
        super().error(shortened(printable(message)))


def parser() -> argparse.ArgumentParser:
    """Make the parser of all commands."""
    raw = argparse.RawDescriptionHelpFormatter
    text = "Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007)."
    root = _Parser(
        prog="remodel-fenicsx", description=text, epilog=MAIN_EPILOG, formatter_class=raw
    )
    _add(root, WITH)
    root.add_argument(
        "--version", action="version", version=__version__, help="Print the version and exit."
    )
    commands = root.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, each in COMMANDS.items():
        text, epilog = each.function.__doc__ or "", f"example:\n  remodel-fenicsx {each.example}"
        about: dict[str, Any] = {"description": text, "epilog": epilog, "formatter_class": raw}
        if text:  # Commands without help text are for the processes of a study.
            about["help"] = text.replace("%", "%%")
        _add(commands.add_parser(name, **about), *each.usage, WITH)
    return root


def _add(target: argparse.ArgumentParser, *usage: str) -> None:
    """Add options from blocks with a line each: names, value with a mark, " = DEFAULT", meaning."""
    for line in "\n".join(map(inspect.cleandoc, usage)).replace("\n    ", " ").splitlines():
        words, _, text = line.partition("  ")
        words, _, default = words.partition(" = ")
        *names, value = words.split()
        settings: dict[str, Any] = {"help": text}
        if value.startswith("-"):
            names.append(value)
            settings["action"] = "store_true"
            if value.startswith("--no-"):
                settings |= {"action": "store_false", "dest": value[5:].replace("-", "_")}
        else:
            kind = value.rstrip("!?+*")
            settings |= {
                "default": default or None,
                "type": TYPE_OF_METAVAR.get(kind, str),
            } | MARKS[value[len(kind) :]]
            settings["choices" if "|" in kind else "metavar"] = (
                kind.split("|") if "|" in kind else kind
            )
        target.add_argument(*names, **settings)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code, one of `EXIT_CODES`."""
    # Replace closed streams: a file of the run would get the number and the output of libraries.
    for stream in (0, 1, 2):
        with contextlib.suppress(OSError):
            os.fstat(stream)
            continue
        os.open(os.devnull, os.O_RDWR)
    sys.stdout, sys.stderr = sys.stdout or open(os.devnull, "w"), sys.stderr or open(
        os.devnull, "w"
    )
    with interrupts.exit_on_signal():
        return _run_command(list(sys.argv[1:] if arguments is None else arguments))


def _run_command(arguments: list[str]) -> int:
    """Run a command and return its exit code; print errors on one line."""
    options = argparse.Namespace()
    try:
        options = _parsed(arguments)
        kernels()  # Checked now: a wrong value would fail only after minutes.
        chosen = COMMANDS[options.command]
        if chosen.alone and not interrupts.is_first_rank():
            return 0
        if getattr(options, "file", None) is not None:
            options.scene = scenes.read_scene(options.file, options.set, options.profile)
        for reason in chosen.needs:
            check_usable(reason())
        return chosen.function(options) or 0
    except RemodelError as error:
        _print_failures(getattr(error, "failed", {}))
        return _fail(error.in_words(), error.exit_code, error.on_all_ranks)
    except OSError as error:
        text, code = f"cannot write the results: {refusal_in_words(error)}", BAD_ENVIRONMENT
        if error.errno == errno.ENAMETOOLONG:
            text, code = refusal_in_words(error), BAD_INPUT
        if getattr(options, "output", None) and isinstance(
            error, (FileExistsError, NotADirectoryError)
        ):
            # The path lies in a file, or was created meanwhile.
            text = (
                f"-o {options.output}: {refusal_in_words(error)}; must be a new or an empty folder"
            )
            code = BAD_INPUT
        return _fail(text, code, on_all_ranks=False)
    except Exception as error:
        if words := blamed(error):
            return _fail(words, BAD_INPUT, on_all_ranks=False)
        traceback.print_exc()
        return _fail(
            "internal error (traceback above); please report it with run.log", 1, on_all_ranks=False
        )


def _parsed(arguments: list[str]) -> argparse.Namespace:
    """Load extensions, then parse the arguments; only the first rank prints usage errors."""
    for word in (*arguments, os.environ.get(EXTENSIONS, "")):
        # Other programs and files could not represent this name.
        if re.search("[\ud800-\udfff]", word):
            raise RemodelError(f"{ascii(word)}: must be UTF-8")
    first = _Parser(prog="remodel-fenicsx", add_help=False, allow_abbrev=False)
    _add(first, WITH)
    with contextlib.ExitStack() as stack:
        if not interrupts.is_first_rank():
            silence = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(silence))
            stack.enter_context(contextlib.redirect_stderr(silence))
        load_extensions(getattr(first.parse_known_args(arguments)[0], "with"))
        return parser().parse_args(arguments)


class OutputError(RemodelError):
    """Failure to write the output of a command."""

    exit_code = BAD_ENVIRONMENT


def _print(*lines: object) -> None:
    if not interrupts.is_first_rank():
        return
    try:
        print(*lines, sep="\n", flush=True)
    except OSError as error:
        # Python flushes again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # The reader of a pipe has read enough.
            raise OutputError(f"cannot write to the standard output: {error.strerror}") from error


def _print_error(message: str) -> None:
    with contextlib.suppress(OSError):  # stderr is closed
        print(f"remodel-fenicsx: {shortened(printable(message))}", file=sys.stderr, flush=True)


def _print_failures(failed: Mapping[str, str]) -> None:
    for name, last_words in failed.items():
        _print_error(f"{name} has failed: {last_words}")


def _fail(message: str, code: int, on_all_ranks: bool) -> int:
    """Print the error and return its code; an error on one of several ranks aborts the others."""
    if interrupts.is_first_rank() or not on_all_ranks:
        _print_error(message)
    mpi = sys.modules.get("mpi4py.MPI")
    if not on_all_ranks and mpi is not None and mpi.COMM_WORLD.size > 1:
        mpi.COMM_WORLD.Abort(code)
    return code


@contextlib.contextmanager
def _stopping(kept: str, path: Path | None = None) -> Iterator[None]:
    """End the command with a line on what is saved if a signal arrives while the block runs."""
    # A new file or folder, which is written atomically, may be complete already.
    new = path if path and not path.exists() else None
    try:
        with interrupts.StopRequest(), interrupts.raise_on_signal():
            yield
    except interrupts.Interrupted as interruption:
        interruption.kept = f"{new} is complete" if new and new.exists() else kept
        raise


# ---------------------------------------------------------------- options of several commands
def _study_options(name: str) -> str:
    """Return the options of commands that run a scene several times."""
    return f"""
    -o --output DIR  Write the results to this folder (default: results/NAME-{name}). Repeat the
        command to resume: finished runs are reused.
    --jobs N  Run at most N runs at a time (default: the number of cores).
    {QUIET}"""


WITH = f"""
    --with FILE.py*  Load a Python file with custom components before reading the scene; repeatable
        (or {EXTENSIONS})."""
QUIET = "-q --quiet  Show warnings only, no progress."
SCHEDULER = """
    --scheduler ADDRESS  Run on the workers of a Dask scheduler: its address, as tcp://HOST:8786, or
        its scheduler file; docs/howto_ranks.md explains it."""
RUN_FOLDER = "folder DIR  The folder of a run."
SCENE_AND_CHANGES = """
    file SCENE  The scene file (TOML); docs/scene.md lists its keys.
    --set KEY=VALUE*  Set one key of the scene, such as cells.seed=2 or time.end=10; repeatable.
    --profile NAME  Use settings of mesh, step and element with a measured error and cost: fast,
        balanced or reference."""
VIEWING = """
    --layers K  Show K layers: of a tube from the inside, of other bodies from the bottom (default:
        all).
    --cut half|quarter  Remove the front half of the body, or the quarter in front and to the
        right.
    --view VIEW = front  View from the front, from above, or from a direction: --view=X,Y,Z
        (default: %(default)s).
    --field fibre_angle_deformed|hoop_stress|axial_stress|max_principal_stress|von_mises_stress
        = fibre_angle_deformed  Colour the elements by this field (default: %(default)s).
    -o --output FILE  Output file; its suffix selects the format. Must not exist (default: {} in
        DIR, numbered if it exists)."""
COMPUTES = (environment_problem,)


# ---------------------------------------------------------------- the commands
@command(
    "run artery.toml -o artery",
    SCENE_AND_CHANGES.replace("SCENE ", "SCENE? "),
    """
    --resume DIR  Resume the run in DIR from its last checkpoint, in place of a new run of SCENE.
    -o --output DIR  Write the results to this folder, which must be new or empty (default:
        results/NAME).
    --max-wall-time TIME  Stop after a whole step before this wall time (30min, 2h) is over, with
        exit code 4.
    --no-report  Write no report.html at the end, as with output.report = false.
    """,
    QUIET,
)
def _run(options: argparse.Namespace) -> None:
    """Solve a scene, or resume a run that was stopped."""
    deadline = None if options.max_wall_time is None else clock.monotonic() + options.max_wall_time
    if (options.file is None) == (options.resume is None):
        raise RemodelError("run: one of SCENE and --resume DIR is required")
    if options.resume and (options.output or options.profile):
        key = "-o" if options.output else "--profile"
        raise RemodelError(f"{key}: a run resumes in its own folder, with its own settings")
    check_usable(environment_problem())
    from remodel_fenicsx.running import resume, run

    wishes: Any = {"quiet": options.quiet, "deadline": deadline, "report": options.report}
    if options.resume:
        folder = resume(options.resume, options.set, **wishes)
    else:
        folder = run(options.scene, options.output, **wishes, overrides=options.set)
    _print(f"results in {folder}")


@command("status artery", RUN_FOLDER)
def _status(options: argparse.Namespace) -> None:
    """Print the progress of the run in DIR, its speed, and whether its process is alive."""
    from remodel_fenicsx.results.status import status

    _print(*map(printable, status(options.folder)))


@command(
    "report artery --open",
    RUN_FOLDER,
    """
    -o --output FILE  Output file; must not exist (default: DIR/report.html, which is replaced).
    --open  Show the page in a browser.
    """,
    alone=True,
)
def _report(options: argparse.Namespace) -> None:
    """Write the run in DIR, finished or not, as a page for a browser."""
    from remodel_fenicsx.report import write_report

    written = write_report(options.folder, options.output)
    _print(written)
    if options.open:
        import webbrowser  # slow to import and seldom needed

        if not webbrowser.open(written.resolve().as_uri()):
            _print_error(f"warning: no browser found; open {written} yourself")


@command(
    "picture artery --time 0 25 150 --cut half",
    RUN_FOLDER,
    VIEWING.format("NAME-t150.png"),
    """
    --time T+  Show these times next to each other, each the nearest recorded time (default: the
        last).
    """,
    alone=True,
)
def _picture(options: argparse.Namespace) -> None:
    """Draw the body of the run in DIR as PNG or PDF."""
    from remodel_fenicsx.pictures import ViewOptions, draw_picture

    viewing = ViewOptions(options.layers, options.cut, options.view, options.field)
    _print(draw_picture(options.folder, options.time, viewing, options.output))


@command(
    "animate artery -o artery.webp --frames 40",
    RUN_FOLDER,
    VIEWING.format("NAME-t0-t150.gif"),
    """
    --frames N = 60  Show at most N recorded times, 2 to 500 (default: %(default)s).
    """,
    alone=True,
)
def _animate(options: argparse.Namespace) -> None:
    """Animate the body of the run in DIR as GIF or WebP."""
    from remodel_fenicsx.pictures import ViewOptions, draw_animation

    viewing = ViewOptions(options.layers, options.cut, options.view, options.field)
    _print(draw_animation(options.folder, options.frames, viewing, options.output))


@command("revolve artery", RUN_FOLDER, alone=True)
def _revolve(options: argparse.Namespace) -> None:
    """Write the fields of a reduced run in DIR on the whole body, for ParaView."""
    from remodel_fenicsx.results.whole_body import revolve

    _print(*revolve(options.folder))


@command(
    "export artery --format febio -o fibres.feb",
    RUN_FOLDER,
    """
    --format vtu|febio|abaqus|csv!  Write vtu (ParaView, meshio), febio (.feb), abaqus (.inp,
        CalculiX too) or csv.
    -o --output FILE  Output file; must not exist (default: fibres in DIR, with the suffix of the
        format).
    --time T  Export this recorded time (default: the last).
    """,
    alone=True,
)
def _export(options: argparse.Namespace) -> None:
    """Export the fibres of the run in DIR for FEBio, Abaqus or ParaView, or as a table."""
    from remodel_fenicsx.results.export import export

    _print(export(options.folder, options.format, options.output, options.time))


@command(
    "new kuhl-holzapfel-2007 --shape tube > mine.toml",
    """
    preset PRESET  The model: kuhl-holzapfel-2007, consistent, sun-2002 or carotid.
    --shape SHAPE = tube  The body: cube, tendon, sheet or tube (default: %(default)s).
    """,
)
def _new(options: argparse.Namespace) -> None:
    """Print a scene of a published model, with every key."""
    scene: Scene = scenes.preset_scene(options.preset, options.shape)
    _print(scene.to_toml(f"a scene of the preset {options.preset}").rstrip("\n"))


@command(
    "wall lumen.stl --thickness 0.6 --size 0.9 -o vessel.msh",
    """
    surface FILE  The surface of the lumen, open at its ends: STL, PLY, VTP or OBJ.
    --thickness VALUE  Thickness of the wall in the unit of the surface, or the name of a point
        array.
    --layers NAME=VALUE+  Layers with their thickness, from the lumen outwards; each is a region.
    --size LENGTH!  Element size along the wall, about its thickness.
    --through K = 2  Elements through the wall, at least one per layer (default: %(default)s).
    -o --output FILE  Output file; must not exist (default: SURFACE.msh).
    """,
    needs=COMPUTES,
    alone=True,
)
def _wall(options: argparse.Namespace) -> None:
    """Mesh a vessel's wall from the surface of its lumen."""
    from remodel_fenicsx.body.lumen import write_wall

    path = options.output or options.surface.with_suffix(".msh")
    with _stopping("nothing is written", path):
        lines = write_wall(
            options.surface,
            path,
            options.thickness,
            options.layers or (),
            options.size,
            options.through,
        )
    _print(*lines)


@command("validate artery.toml", SCENE_AND_CHANGES)
def _validate(options: argparse.Namespace) -> None:
    """Check a scene without running it, and show the settings that a run would use."""
    from remodel_fenicsx.body.reductions import describe_choice

    scene, unseen = options.scene, ""
    warnings = []
    if interrupts.is_first_rank():
        unseen, warnings = _unseen_files(scene), scene.warnings()
    _print(f"{options.file}: a valid scene ({scene.geometry.name}, {scene.time.in_words()})")
    _print(scene.summary(), *describe_choice(scene), scene.describe_formulation())
    if scene.profile is not None:
        _print(presets.profile_for(scene.profile, scene).in_words(scene.profile))
    for warning in warnings:
        _print_error(f"warning: {warning}")
    if unseen:
        _print(f"not checked: {unseen}")


def _unseen_files(scene: Scene) -> str:
    """Check a scene's files as a run would; describe those that were not checked."""
    if not scene.measured_cells and not scene.geometry.kept_files()[1]:
        return ""
    if (reason := environment_problem()) is not None:
        return f"the scene's files; {reason}"
    from remodel_fenicsx.initial import check_files

    return check_files(scene)


@command(
    "axes artery.toml -o artery-axes.vtu",
    SCENE_AND_CHANGES,
    "-o --output FILE  Output file; must not exist (default: NAME-axes.vtu).",
    needs=COMPUTES,
)
def _axes(options: argparse.Namespace) -> None:
    """Write the local axes of a scene's body as a VTU file, before any solve."""
    from remodel_fenicsx.running import write_axes

    path = options.output or Path(f"{options.scene.name}-axes.vtu")
    with _stopping("nothing is written", path):
        _print(f"{write_axes(options.scene, path)}\nlocal axes in {path}")


@command(
    "unload scanned.toml -o unloaded",
    SCENE_AND_CHANGES,
    "-o --output FOLDER  Write scene and mesh to this new folder (default: NAME-unloaded).",
    needs=COMPUTES,
    alone=True,
)
def _unload(options: argparse.Namespace) -> None:
    """Compute the unloaded body of a scene whose geometry is the loaded one."""
    from remodel_fenicsx.running import write_unloaded

    if not options.scene.geometry.is_loaded:
        raise scenes.SceneError(
            "geometry.is = 'unloaded': must be 'loaded' to compute the unloaded body"
        )
    place = options.output or Path(f"{options.scene.name}-unloaded")
    with _stopping("nothing is written", place):
        write_unloaded(options.scene, place)
    _print(f"scene of the unloaded body in {place / 'scene.toml'}")


@command(
    "schema -o scene.schema.json",
    "-o --output FILE  Output file; must not exist (default: print the schema).",
    alone=True,
)
def _schema(options: argparse.Namespace) -> None:
    """Print the JSON Schema of scenes, with which an editor completes and checks keys."""
    from remodel_fenicsx.scene.reference import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
    if options.output is not None:
        write_new(options.output, f"{text}\n".encode())
        text = f"JSON Schema in {options.output}"
    _print(text)


def _run_study(
    study: Callable[..., tuple[Path, StudyResult]], options: argparse.Namespace, **others: object
) -> int:
    """Run a study with all options that it takes; print its result, folder and failed runs."""
    names = inspect.signature(study).parameters.keys() & vars(options)
    others |= {name: vars(options)[name] for name in names}
    with _stopping("all recorded results are saved; repeat the command to resume"):
        folder, result = study(folder=options.output, **others)
    _print(f"{result.in_words()}\nresults in {folder}")
    _print_failures(result.failed)
    return SOLVE_FAILED if result.failed else 0


@command(
    "sweep mine.toml loads.pressure.value=2:6:5",
    SCENE_AND_CHANGES,
    """
    axes KEY=a:b:n+  Vary a key: KEY=a:b:n takes n values from a to b, KEY=a,b,... takes these
        values. All combinations are run.
    --latin N  Run N points of a Latin hypercube in place of all combinations; each key is then
        KEY=a:b.
    --seed SEED = 1  Seed of the Latin hypercube (default: %(default)s).
    """,
    _study_options("sweep"),
    SCHEDULER,
    needs=COMPUTES,
)
def _sweep(options: argparse.Namespace) -> int:
    """Run a scene over parameter values, and show how its end depends on them."""
    from remodel_fenicsx.studies import sweep as study

    is_sampled = options.latin is not None
    axes = study.read_axes(options.axes, is_sampled)
    points = (
        study.latin_hypercube(axes, options.latin, options.seed) if is_sampled else study.grid(axes)
    )
    return _run_study(study.sweep, options, points=points, sampled=is_sampled)


@command(
    "ensemble artery.toml --seeds 32 -o seeds",
    SCENE_AND_CHANGES,
    "--seeds N = 32  Number of seeds, at least 2 (default: %(default)s).",
    _study_options("ensemble"),
    SCHEDULER,
    needs=COMPUTES,
)
def _ensemble(options: argparse.Namespace) -> int:
    """Run a scene of random cells with many seeds."""
    from remodel_fenicsx.studies.sweep import ensemble

    return _run_study(ensemble, options)


@command(
    "trade artery.toml --budget 10min",
    SCENE_AND_CHANGES,
    """
    --budget TIME = 10min  Stop after this wall time (default: %(default)s). Cheap runs come first;
        repeat the command with a larger budget to resume.
    """,
    _study_options("trade"),
    SCHEDULER,
    needs=COMPUTES,
)
def _trade(options: argparse.Namespace) -> int:
    """Run a scene with coarse and fine settings, and show the cost and error of each."""
    from remodel_fenicsx.studies.trade import trade

    return _run_study(trade, options)


@command(
    "fit tube.toml inflation.toml -o fitted",
    SCENE_AND_CHANGES,
    """
    data DATA  A TOML file with the unknowns and the tables of measurements; docs/fit.md explains
        it.
    --no-likelihood-profiles  Skip the likelihood profiles of correlated unknowns.
    --starts N = 3  Start from N points: the point of DATA, and others within a factor of two
        (default: %(default)s).
    """,
    _study_options("fit"),
    needs=COMPUTES,
)
def _fit(options: argparse.Namespace) -> int:
    """Fit parameters of a scene to measurements, with 95 % confidence intervals."""
    from remodel_fenicsx.studies.fit import fit

    return _run_study(fit, options, profiles=options.likelihood_profiles)


@command(
    "stability artery.toml --times 5 -o stable",
    SCENE_AND_CHANGES,
    """
    -o --output DIR  Write the results to this folder, which must be new or empty (default:
        results/NAME-stability).
    --times N = 10  Analyse N times of the run (default: %(default)s).
    """,
    QUIET,
    needs=COMPUTES,
)
def _stability(options: argparse.Namespace) -> None:
    """Run a scene and report whether its remodeling passes damp or amplify small errors."""
    from remodel_fenicsx.studies.stability import stability

    place, result = stability(options.scene, options.output, options.times, quiet=options.quiet)
    _print(f"{result.in_words()}\nresults in {place}")


@command("info", needs=COMPUTES)
def _info(options: argparse.Namespace) -> None:
    """Print the versions of the program and its libraries, the solvers and the BLAS."""
    from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS

    for name, version in (versions() | {"solver methods": ", ".join(SOLVER_METHODS)}).items():
        _print(f"{name:16} {version}")


@command(PART, "file_of_part FILE  The task; the answer replaces it.", needs=COMPUTES)
def _part(options: argparse.Namespace) -> None:
    from remodel_fenicsx.studies.fit import do_part

    do_part(options.file_of_part)


@command(SERVE)
def _serve(options: argparse.Namespace) -> int:
    return serve(main)


if __name__ == "__main__":
    sys.exit(main())
