"""The command remodel-fenicsx: thin, no numerics."""

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
from remodel_fenicsx.errors import BAD_ENVIRONMENT, BAD_INPUT, PAUSED, RemodelError, SOLVE_FAILED, printable, shortened
from remodel_fenicsx.system import interrupts
from remodel_fenicsx.system.children import PART, SERVE, serve
from remodel_fenicsx.system.environment import (
    EXTENSIONS,
    blamed,
    check_usable,
    kernels,
    load_extensions,
    reason_unusable,
    versions,
)
from remodel_fenicsx.system.files import positive, refusal_in_words, wall_time, write_new

if TYPE_CHECKING:
    from remodel_fenicsx.studies.study import Answer
    from remodel_fenicsx.scene.scene import Scene

presets, scenes = Late("remodel_fenicsx.scene.presets"), Late("remodel_fenicsx.scene.scene")  # no help needs them

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
MAIN_EPILOG = (
    "examples:\n"
    "  remodel-fenicsx new kuhl-holzapfel-2007 > artery.toml\n"
    "  remodel-fenicsx run artery.toml -o artery\n"
    "  remodel-fenicsx report artery --open\n\n"
    "'remodel-fenicsx COMMAND --help' explains a command; docs/commands.md explains all.\n\n"
    "exit codes:\n" + "\n".join(f"  {code:<5}{meaning}" for code, meaning in EXIT_CODES.items())
)


# ---------------------------------------------------------------- how a command is typed and ends
Do = Callable[[argparse.Namespace], int | None]
Needs = Sequence[Callable[[], str | None]]
KINDS: dict[str, Callable[[str], object]] = {
    **dict.fromkeys(("DATA", "DIR", "FILE", "FOLDER", "SCENE"), Path),
    **{"K": int, "LENGTH": float, "N": positive, "SEED": int, "T": float, "TIME": wall_time},
}
# what a mark behind a value means: required, may be left out, one or more, may be given several times
MARKS: dict[str, dict[str, Any]] = {
    "": {},
    "!": {"required": True},
    "?": {"nargs": "?"},
    "+": {"nargs": "+"},
    "*": {"action": "append", "default": []},
}


class Command(NamedTuple):
    """What a command takes and does; an example is what follows the program's name."""

    do: Do
    example: str
    usage: Sequence[str]
    needs: Needs
    alone: bool


COMMANDS: dict[str, Command] = {}  # by name, in the order of the help


def command(example: str, *usage: str, needs: Needs = (), alone: bool = False) -> Callable[[Do], Do]:
    """Of a function: makes it a command, whose help is its docstring."""

    # it gets the options, with the scene where the command takes one, and returns an exit code, or None for 0; it is
    # called where nothing that it needs is missing; where it works alone, on the first of several ranks only
    def listed(do: Do) -> Do:
        COMMANDS[example.partition(" ")[0]] = Command(do, example, usage, needs, alone)
        return do

    return listed


class _Parser(argparse.ArgumentParser):
    """What it complains of stays on one line, control characters and all."""

    def error(self, message: str) -> NoReturn:
        super().error(shortened(printable(message)))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    raw = argparse.RawDescriptionHelpFormatter
    text = "Predict how collagen in living tissue reorients under load (Kuhl & Holzapfel 2007)."
    found = _Parser(prog="remodel-fenicsx", description=text, epilog=MAIN_EPILOG, formatter_class=raw)
    _add(found, WITH)
    found.add_argument("--version", action="version", version=__version__, help="Print the version and end.")
    commands = found.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, each in COMMANDS.items():
        text, epilog = each.do.__doc__ or "", f"example:\n  remodel-fenicsx {each.example}"
        about: dict[str, Any] = {"description": text, "epilog": epilog, "formatter_class": raw}
        if text:  # else it is for the processes of a study
            about["help"] = text.replace("%", "%%")
        _add(commands.add_parser(name, **about), *each.usage, WITH)
    return found


def _add(found: argparse.ArgumentParser, *usage: str) -> None:
    """Add the options of blocks with a line for each: names, its value with a mark and " = DEFAULT", meaning."""
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
            settings |= {"default": default or None, "type": KINDS.get(kind, str)} | MARKS[value[len(kind) :]]
            settings["choices" if "|" in kind else "metavar"] = kind.split("|") if "|" in kind else kind
        found.add_argument(*names, **settings)


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
    options = argparse.Namespace()
    try:
        options = _parsed(arguments)
        kernels()  # not after minutes, when they are asked for
        chosen = COMMANDS[options.command]
        if chosen.alone and not interrupts.is_first_rank():
            return 0
        if getattr(options, "file", None) is not None:
            options.scene = scenes.read_scene(options.file, options.set, options.profile)
        for reason in chosen.needs:
            check_usable(reason())
        return chosen.do(options) or 0
    except RemodelError as error:
        _complain_of(getattr(error, "failed", {}))
        return _fail(error.in_words(), error.exit_code, error.on_all_ranks)
    except OSError as error:
        text, code = f"cannot write the results: {refusal_in_words(error)}", BAD_ENVIRONMENT
        if error.errno == errno.ENAMETOOLONG:
            text, code = refusal_in_words(error), BAD_INPUT
        if getattr(options, "output", None) and isinstance(error, (FileExistsError, NotADirectoryError)):
            # lies in a file, or just taken
            text = f"-o {options.output}: {refusal_in_words(error)}; allowed is a new or an empty folder"
            code = BAD_INPUT
        return _fail(text, code, on_all_ranks=False)
    except Exception as error:
        if words := blamed(error):
            return _fail(words, BAD_INPUT, on_all_ranks=False)
        traceback.print_exc()
        return _fail("stopped by a defect of the program, see above", 1, on_all_ranks=False)


def _parsed(arguments: list[str]) -> argparse.Namespace:
    """The options, after the extensions; of several ranks only the first says what is wrong with them."""
    for word in (*arguments, os.environ.get(EXTENSIONS, "")):
        if re.search("[\ud800-\udfff]", word):  # records and other programs could not name it
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
    """What a command says cannot be written."""

    exit_code = BAD_ENVIRONMENT


def _say(*lines: object) -> None:
    if not interrupts.is_first_rank():
        return
    try:
        print(*lines, sep="\n", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python will flush once more
        if not isinstance(error, BrokenPipeError):  # whoever read the output has seen enough
            raise OutputError(f"cannot write to the standard output: {error.strerror}") from error


def _complain(message: str) -> None:
    with contextlib.suppress(OSError):  # nobody is there to read it
        print(f"remodel-fenicsx: {shortened(printable(message))}", file=sys.stderr, flush=True)


def _complain_of(failed: Mapping[str, str]) -> None:
    for name, last_words in failed.items():
        _complain(f"{name} has failed: {last_words}")


def _fail(message: str, code: int, on_all_ranks: bool) -> int:
    """Say what has ended the command; an error on one of several ranks would leave the others waiting for ever."""
    if interrupts.is_first_rank() or not on_all_ranks:
        _complain(message)
    mpi = sys.modules.get("mpi4py.MPI")
    if not on_all_ranks and mpi is not None and mpi.COMM_WORLD.size > 1:
        mpi.COMM_WORLD.Abort(code)
    return code


@contextlib.contextmanager
def _stopping(kept: str) -> Iterator[None]:
    """Within, a signal ends the command at once, which says what is kept."""
    try:
        with interrupts.StopRequest(), interrupts.stopping_at_once():
            yield
    except interrupts.Interrupted as interruption:
        interruption.kept = kept
        raise


# ---------------------------------------------------------------- what several commands take
def _study(name: str) -> str:
    """What those take that run a scene several times."""
    return f"""
    -o --output DIR  Put the results into this folder (default: results/NAME-{name}). The same
        command goes on there: finished runs are used again.
    --jobs N  Do at most N runs at a time (default: as many as there are cores).
    {QUIET}"""


WITH = f"""
    --with FILE.py*  Run this Python file first, whose parts scenes may then name; repeatable (or
        {EXTENSIONS})."""
QUIET = "-q --quiet  Show no progress, only warnings."
RUN_FOLDER = "folder DIR  The folder of a run."
SCENE_AND_CHANGES = """
    file SCENE  The scene file (TOML); docs/scene.md lists its keys.
    --set KEY=VALUE*  Change one key of the scene, such as cells.seed=2 or time.end=10. May be
        repeated.
    --profile NAME  Mesh, step and element as measured for speed or accuracy: fast, balanced or
        reference."""
VIEWING = """
    --layers K  Show this many layers: of a tube from the inside, of others from the bottom
        (default: all).
    --cut half|quarter  Leave out the half in front of the middle, or only the quarter in front and
        to the right.
    --view VIEW = front  Look from the front, from above, or from X,Y,Z of the middle: --view=X,Y,Z
        (default: %(default)s).
    -o --output FILE  Write to this new file, whose ending says the kind (default: {} in DIR,
        numbered when taken)."""
COMPUTES = (reason_unusable,)


# ---------------------------------------------------------------- the commands
@command(
    "run artery.toml -o artery",
    SCENE_AND_CHANGES.replace("SCENE ", "SCENE? "),
    """
    --resume DIR  Go on with the run in DIR from its last checkpoint, in place of a new run of
        SCENE.
    -o --output DIR  Put the results into this folder, which must be new or empty (default:
        results/NAME).
    --max-wall-time TIME  Stop before this time (30min, 2h) is over: after a whole step, with exit
        code 4.
    --no-report  Make no report.html at the end, as with output.report = false.
    """,
    QUIET,
)
def _run(options: argparse.Namespace) -> None:
    """Solve a scene, or go on with a run that was stopped."""
    deadline = None if options.max_wall_time is None else clock.monotonic() + options.max_wall_time
    if (options.file is None) == (options.resume is None):
        raise RemodelError("run: one of SCENE and --resume DIR is required")
    if options.resume and (options.output or options.profile):
        key = "-o" if options.output else "--profile"
        raise RemodelError(f"{key}: a run goes on in its own folder, with its own settings")
    check_usable(reason_unusable())
    from remodel_fenicsx.running import resume, run

    wishes: Any = {"quiet": options.quiet, "deadline": deadline, "report": options.report}
    if options.resume:
        folder = resume(options.resume, options.set, **wishes)
    else:
        folder = run(options.scene, options.output, **wishes)
    _say(f"results in {folder}")


@command("status artery", RUN_FOLDER)
def _status(options: argparse.Namespace) -> None:
    """Say where the run in DIR is, how fast it is, and whether it is alive."""
    from remodel_fenicsx.results.status import status

    _say(*map(printable, status(options.folder)))


@command(
    "report artery --open",
    RUN_FOLDER,
    """
    -o --output FILE  Write the page to this new file (default: DIR/report.html, which is made
        anew).
    --open  Show the page in a browser.
    """,
    alone=True,
)
def _report(options: argparse.Namespace) -> None:
    """Make the page of the run in DIR for a browser, finished or not."""
    from remodel_fenicsx.report import write_report

    written = write_report(options.folder, options.output)
    _say(written)
    if options.open:
        import webbrowser  # slow to import, and seldom asked for

        if not webbrowser.open(written.resolve().as_uri()):
            _complain(f"warning: no browser was found; open {written} in yours")


@command(
    "picture artery --time 0 25 150 --cut half",
    RUN_FOLDER,
    VIEWING.format("NAME-t150.png"),
    """
    --time T+  Show these times beside each other, each the nearest recorded one (default: the
        last).
    """,
    alone=True,
)
def _picture(options: argparse.Namespace) -> None:
    """Draw the body of the run in DIR: PNG or PDF."""
    from remodel_fenicsx.pictures import Viewing, draw_picture

    viewing = Viewing(options.layers, options.cut, options.view)
    _say(draw_picture(options.folder, options.time, viewing, options.output))


@command(
    "animate artery -o artery.webp --frames 40",
    RUN_FOLDER,
    VIEWING.format("NAME-t0-t150.gif"),
    """
    --frames N = 60  Show this many recorded times, 2 to 500 (default: %(default)s, or all where
        there are fewer).
    """,
    alone=True,
)
def _animate(options: argparse.Namespace) -> None:
    """Draw the body of the run in DIR as it moves: GIF or WebP."""
    from remodel_fenicsx.pictures import Viewing, draw_animation

    viewing = Viewing(options.layers, options.cut, options.view)
    _say(draw_animation(options.folder, options.frames, viewing, options.output))


@command("revolve artery", RUN_FOLDER, alone=True)
def _revolve(options: argparse.Namespace) -> None:
    """Write the fields of a reduced run in DIR on the whole body, for ParaView."""
    from remodel_fenicsx.results.whole_body import revolve

    _say(*revolve(options.folder))


@command(
    "export artery --format febio -o fibres.feb",
    RUN_FOLDER,
    """
    --format vtu|febio|abaqus|csv!  Write vtu (ParaView, meshio), febio (.feb), abaqus (.inp,
        CalculiX too) or csv.
    -o --output FILE  Write to this new file (default: fibres in DIR, with the ending of the
        format).
    --time T  Take this recorded time (default: the last).
    """,
    alone=True,
)
def _export(options: argparse.Namespace) -> None:
    """Write the fibres of the run in DIR for FEBio, Abaqus, ParaView or as a table."""
    from remodel_fenicsx.results.export import export

    _say(export(options.folder, options.format, options.output, options.time))


@command(
    "new kuhl-holzapfel-2007 --shape tube > mine.toml",
    """
    preset PRESET  The model: kuhl-holzapfel-2007, consistent or sun-2002.
    --shape SHAPE = tube  The body: cube, tendon, sheet or tube (default: %(default)s).
    """,
)
def _new(options: argparse.Namespace) -> None:
    """Print a scene of a published model, with every key."""
    scene: Scene = scenes.preset_scene(options.preset, options.shape)
    _say(scene.to_toml(f"a scene of the preset {options.preset}").rstrip("\n"))


@command(
    "wall lumen.stl --thickness 0.6 --size 0.9 -o vessel.msh",
    """
    surface FILE  The surface of the lumen, open at its ends: STL, PLY, VTP or OBJ.
    --thickness VALUE  Thickness of the wall in the unit of the surface, or the name of an array at
        its points.
    --layers NAME=VALUE+  Layers from the lumen outwards, each a region, with their thickness.
    --size LENGTH!  Length of an element along the wall, about its thickness.
    --through K = 2  Elements through the wall, at least one a layer (default: %(default)s).
    -o --output FILE  Write to this new file (default: SURFACE.msh).
    """,
    needs=COMPUTES,
    alone=True,
)
def _wall(options: argparse.Namespace) -> None:
    """Make the mesh of a vessel's wall from the surface of its lumen."""
    from remodel_fenicsx.body.lumen import write_wall

    path = options.output or options.surface.with_suffix(".msh")
    with _stopping("nothing is written"):
        lines = write_wall(
            options.surface, path, options.thickness, options.layers or (), options.size, options.through
        )
    _say(*lines)


@command("validate artery.toml", SCENE_AND_CHANGES)
def _validate(options: argparse.Namespace) -> None:
    """Check a scene without running it, and show what it means."""
    from remodel_fenicsx.body.reductions import explained

    scene, unseen, warnings = options.scene, "", []
    if interrupts.is_first_rank():
        unseen, warnings = _unseen_files(scene), scene.warnings()
    _say(f"{options.file}: a valid scene ({scene.geometry.name}, {scene.time.in_words()})")
    _say(scene.summary(), *explained(scene), scene.formulation_in_words())
    if scene.profile is not None:
        _say(presets.profile_for(scene.profile, scene).in_words(scene.profile))
    for warning in warnings:
        _complain(f"warning: {warning}")
    if unseen:
        _say(f"not looked at: {unseen}")


def _unseen_files(scene: Scene) -> str:
    """What was not looked at of the files that a scene names; an error where a run would refuse one."""
    if not scene.measured_cells and not scene.geometry.kept_files()[1]:
        return ""
    if (reason := reason_unusable()) is not None:
        return f"the files that it names; {reason}"
    from remodel_fenicsx.initial import check_files

    return check_files(scene)


@command(
    "axes artery.toml -o artery-axes.vtu",
    SCENE_AND_CHANGES,
    "-o --output FILE  Write to this new file (default: NAME-axes.vtu).",
    needs=COMPUTES,
)
def _axes(options: argparse.Namespace) -> None:
    """Write the local axes of a scene's body as a VTU file, before any solve."""
    from remodel_fenicsx.running import write_axes

    path = options.output or Path(f"{options.scene.name}-axes.vtu")
    with _stopping("nothing is written"):
        _say(f"{write_axes(options.scene, path)}\nlocal axes in {path}")


@command(
    "unload scanned.toml -o unloaded",
    SCENE_AND_CHANGES,
    "-o --output FOLDER  Put its scene and mesh into this new folder (default: NAME-unloaded).",
    needs=COMPUTES,
)
def _unload(options: argparse.Namespace) -> None:
    """Find the unloaded body of a scene whose geometry is the loaded one."""
    from remodel_fenicsx.running import write_unloaded

    if not options.scene.geometry.is_loaded:
        raise scenes.SceneError("geometry.is = 'unloaded': the body is unloaded already; allowed is 'loaded'")
    place = options.output or Path(f"{options.scene.name}-unloaded")
    with _stopping("nothing is written"):
        write_unloaded(options.scene, place)
    _say(f"scene of the unloaded body in {place / 'scene.toml'}")


@command(
    "schema -o scene.schema.json",
    "-o --output FILE  Write it to this new file (default: print it).",
    alone=True,
)
def _schema(options: argparse.Namespace) -> None:
    """Print the JSON Schema of scenes, with which an editor completes and checks keys."""
    from remodel_fenicsx.scene.reference import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
    if options.output is not None:
        write_new(options.output, f"{text}\n".encode())
        text = f"JSON Schema in {options.output}"
    _say(text)


def _answer(study: Callable[..., tuple[Path, Answer]], *wishes: object) -> int:
    """Do a study; say what it has found, where, and which of its runs have failed."""
    with _stopping("all that is recorded is kept, the same command goes on"):
        folder, found = study(*wishes)
    _say(f"{found.in_words()}\nresults in {folder}")
    _complain_of(found.failed)
    return SOLVE_FAILED if found.failed else 0


@command(
    "sweep mine.toml loads.pressure.value=2:6:5",
    SCENE_AND_CHANGES,
    """
    axes KEY=a:b:n+  Vary a key: KEY=a:b:n takes n numbers from a to b, KEY=a,b,... these. Keys are
        combined.
    --latin N  Take N points of a Latin hypercube in place of all combinations. Each key is then
        KEY=a:b.
    --seed SEED = 1  Draw the Latin hypercube from this seed (default: %(default)s).
    """,
    _study("sweep"),
    needs=COMPUTES,
)
def _sweep(options: argparse.Namespace) -> int:
    """Run a scene with other numbers, and show how its end depends on them."""
    from remodel_fenicsx.studies import sweep as study

    is_sampled = options.latin is not None
    axes = study.read_axes(options.axes, is_sampled)
    points = study.latin_hypercube(axes, options.latin, options.seed) if is_sampled else study.grid(axes)
    wishes = options.output, options.jobs, options.quiet, is_sampled
    return _answer(study.sweep, options.scene, points, *wishes)


@command(
    "ensemble artery.toml --seeds 32 -o seeds",
    SCENE_AND_CHANGES,
    "--seeds N = 32  Use this many seeds (default: %(default)s; at least 2).",
    _study("ensemble"),
    needs=COMPUTES,
)
def _ensemble(options: argparse.Namespace) -> int:
    """Run a scene of random cells with many seeds."""
    from remodel_fenicsx.studies.sweep import ensemble

    return _answer(ensemble, options.scene, options.output, options.seeds, options.jobs, options.quiet)


@command(
    "trade artery.toml --budget 10min",
    SCENE_AND_CHANGES,
    """
    --budget TIME = 10min  Stop after this wall time (default: %(default)s). Cheap runs come first;
        a larger budget goes on.
    """,
    _study("trade"),
    needs=COMPUTES,
)
def _trade(options: argparse.Namespace) -> int:
    """Run a scene with coarse and fine settings: what each costs, and how far off it is."""
    from remodel_fenicsx.studies.trade import trade

    return _answer(trade, options.scene, options.output, options.budget, options.jobs, options.quiet)


@command(
    "fit tube.toml inflation.toml -o fitted",
    SCENE_AND_CHANGES,
    """
    data DATA  A TOML file with the unknowns and the tables of measurements; docs/fit.md explains
        it.
    --no-likelihood-profiles  Leave out the likelihood profiles of unknowns that depend on each
        other.
    --starts N = 3  Start from N points: the given one, and others within a factor of two (default:
        %(default)s).
    """,
    _study("fit"),
    needs=COMPUTES,
)
def _fit(options: argparse.Namespace) -> int:
    """Find numbers of a scene from measurements, with 95 % bands."""
    from remodel_fenicsx.studies.fit import fit

    wishes = options.starts, options.quiet, options.likelihood_profiles, options.jobs
    return _answer(fit, options.scene, options.data, options.output, *wishes)


@command(
    "stability artery.toml --times 5 -o stable",
    SCENE_AND_CHANGES,
    """
    -o --output DIR  Put the results into this new or empty folder (default:
        results/NAME-stability).
    --times N = 10  Look at N times of the run (default: %(default)s).
    """,
    QUIET,
    needs=COMPUTES,
)
def _stability(options: argparse.Namespace) -> None:
    """Run a scene and say whether its remodeling passes damp small errors or amplify them."""
    from remodel_fenicsx.studies.stability import stability

    place, found = stability(options.scene, options.output, options.times, quiet=options.quiet)
    _say(f"{found.in_words()}\nresults in {place}")


@command("info", needs=COMPUTES)
def _info(options: argparse.Namespace) -> None:
    """Print the versions of the program and its libraries, the solvers and the BLAS."""
    from remodel_fenicsx.fem.solver_methods import SOLVER_METHODS

    for name, version in (versions() | {"solver methods": ", ".join(SOLVER_METHODS)}).items():
        _say(f"{name:16} {version}")


@command(PART, "file_of_part FILE  The task, which its answer replaces.", needs=COMPUTES)
def _part(options: argparse.Namespace) -> None:
    from remodel_fenicsx.studies.fit import do_part

    do_part(options.file_of_part)


@command(SERVE)
def _serve(options: argparse.Namespace) -> int:
    return serve(main)


if __name__ == "__main__":
    sys.exit(main())
