"""A scene and the folder of a run are data: what somebody else has put into them runs nothing and leads nowhere.

Each attack is tried through the command line or the function that it goes through; the victim is a file beside.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from remodel_fenicsx import Recording, SceneError, Simulation
from remodel_fenicsx.results.checkpoint_file import CheckpointError
from remodel_fenicsx.results.recording import RecordingError
from remodel_fenicsx.results.run_folder import choose_folder
from remodel_fenicsx.results.vtkhdf import check_series
from remodel_fenicsx.running import resume, run as run_scene
from remodel_fenicsx.scene import preset_scene, read_scene
from remodel_fenicsx.schema.text import LARGEST, MOST_PARTS
from tests.command.test_run import demo, refusal_of, run
from tests.forks import forked
from tests.parts import pulled_cube
from tests.processes import ran
from tests.runs import made

PROJECT = Path(__file__).parents[2]
SELF = MPI.COMM_SELF
LONGER = ["time.end=4.0"]
Change = Callable[[dict[str, Any], dict[str, Any]], None]
MINE = b"what a user would not like to lose\n"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube to t = 3, with a checkpoint after each step."""
    scene = pulled_cube(3.0, output={"checkpoint": 1})
    return run_scene(scene, tmp_path_factory.mktemp("finished") / "run", SELF)


@pytest.fixture
def folder(tmp_path: Path, finished: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(finished, tmp_path / "run")


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file outside of the folder."""
    path = tmp_path / "victim"
    path.write_bytes(MINE)
    return path


def content(folder: Path) -> dict[str, bytes]:
    """Of all its files."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


# ---------------------------------------------------------------- PETSc's options
OPTIONS = tomllib.loads((Path(__file__).parent / "petsc_options.toml").read_text())
TAKEN = OPTIONS.pop("taken")


@pytest.mark.parametrize(
    ("name", "value"), [item for options in OPTIONS.values() for item in options.items()]
)
def test_an_option_that_does_more_than_solve_is_refused(name: str, value: Any) -> None:
    with pytest.raises(
        SceneError, match=rf"^solver\.petsc_options\.{name} = .*: .*; allowed: "
    ) as refusal:
        preset_scene("kuhl-holzapfel-2007", "cube").with_values(
            {f"solver.petsc_options.{name}": value}
        )
    assert len(str(refusal.value).splitlines()) == 1


def test_options_of_solvers_are_taken() -> None:
    scene = preset_scene("kuhl-holzapfel-2007", "cube").with_values({"solver.petsc_options": TAKEN})
    assert scene.solver.petsc_options == TAKEN


# ---------------------------------------------------------------- links
NEVER_THROUGH = ("run.lock", "history.csv", "run.log")
REPLACED = "fields.vtkhdf fields_chains.vtkhdf scene.toml.part checkpoint-a.npz.part checkpoint-b.npz.part".split()


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
@pytest.mark.parametrize("names", [*([name] for name in NEVER_THROUGH), REPLACED], ids=" ".join)
def test_nothing_is_written_through_a_link(
    names: list[str], kind: str, folder: Path, tmp_path: Path
) -> None:
    before = {}
    for name in names:
        path, victim = folder / name, tmp_path / f"victim of {name}"
        before[victim] = (
            path.read_bytes() if path.exists() else MINE
        )  # a valid one: but it is another file
        victim.write_bytes(before[victim])
        path.unlink(missing_ok=True)
        (path.hardlink_to if kind == "hard" else path.symlink_to)(victim)
    others = content(folder)
    if names is REPLACED:
        resume(folder, LONGER, SELF)
        assert Recording(folder).history["time"][-1] == 4.0
    else:
        assert names[0] in refusal_of("run", "--resume", folder, "--set", LONGER[0], "-q")
        assert content(folder) == others
    assert {victim: victim.read_bytes() for victim in before} == before


@pytest.mark.parametrize("name", ["seed-1", "ensemble.csv"])
def test_a_study_writes_through_no_link(name: str, tmp_path: Path, victim: Path) -> None:
    """The folder of a study, with a link in it, from somebody else."""
    study = tmp_path / "study"
    study.mkdir()
    target = victim
    if name == "seed-1":
        target = tmp_path / "elsewhere"
        target.mkdir()
    (study / name).symlink_to(target)
    random = ["--set", "cells.initial=random", "--set", "time.end=1", "--set", "mesh.refinement=1"]
    done = run("ensemble", demo("cube"), *random, "--seeds", "2", "--jobs", "1", "-o", study, "-q")
    assert victim.read_bytes() == MINE and "Traceback" not in done.stderr
    assert done.returncode == 2, done.stderr
    assert name != "seed-1" or not list(target.iterdir())


# ---------------------------------------------------------------- checkpoints that somebody has made
def forged(folder: Path, change: Change, compressed: bool = False) -> None:
    """Both checkpoints with another header or other arrays."""
    for path in folder.glob("checkpoint*"):
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files if name != "header"}
            header = json.loads(file["header"].tobytes())
        change(header, arrays)
        whole = io.BytesIO()
        text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
        (np.savez_compressed if compressed else np.savez)(whole, header=text, **arrays)
        path.write_bytes(whole.getvalue())


def put(key: str, value: Any) -> Change:
    """Another entry of the header; with a value that is callable, what it makes of the old one."""
    return lambda header, arrays: header.update(
        {key: value(header.get(key)) if callable(value) else value}
    )


def array(name: str, make: Callable[[Any], Any]) -> Change:
    """Another array in place of one, or of the first function's."""

    def change(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        key = f"function/{header['functions'][0]}" if name == "function" else name
        arrays[key] = make(arrays[key])

    return change


def without(name: str) -> Change:
    """An entry less, of header or arrays."""

    def change(header: dict[str, Any], arrays: dict[str, Any]) -> None:
        (header if name in header else arrays).pop(
            name if name != "function" else f"function/{header['functions'][0]}"
        )

    return change


ODD = {
    "text": "x",
    "none": None,
    "list": [1],
    "table": {"a": 1},
    "negative": -1,
    "true": True,
    "many": 10**400,
}
FORGERIES = {
    **{
        f"{key} {name}": put(key, value)
        for key in (
            "time",
            "number",
            "scene",
            "versions",
            "loads",
            "numbers",
            "functions",
            "format",
        )
        for name, value in ODD.items()
        # what is no forgery: a checkpoint that could have been written, or one whose fault is harmless
        if f"{key} {name}" not in ("scene text", "time true", "numbers table")
    },
    "no time": without("time"),
    "no points": without("points"),
    "no function": without("function"),
    "loads NaN": put("loads", {"force": float("nan")}),
    "numbers of lists": put("numbers", {"a": [1.0]}),
    "functions twice": put("functions", lambda names: names[:1]),
    "another load": put("loads", {"other": 1.0}),
    "a later step": put("number", lambda number: number + 7),
    "another time": put("time", lambda time: time + 0.5),
    "another scene": put("scene", lambda text: text.replace("kappa = ", "kappa = 9")),
    "no scene": put("scene", "x = 1"),
    "a row less": array("function", lambda old: old[:-1]),
    "a column less": array("function", lambda old: old[:, :-1]),
    "empty": array("function", lambda old: old[:0]),
    "NaN": array("function", lambda old: old * np.nan),
    "moved points": array("points", lambda old: old + 1.0),
    "other elements": array("elements", lambda old: old[:, ::-1]),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_checkpoint_is_refused(name: str, folder: Path) -> None:
    """With right check sums; nothing is changed by the refusal."""
    forged(folder, FORGERIES[name])
    before = content(folder)
    with pytest.raises((CheckpointError, SceneError, RecordingError)) as refusal:
        resume(folder, LONGER, SELF)
    assert len(str(refusal.value).splitlines()) == 1
    assert content(folder) == before


def bomb(folder: Path) -> None:
    """A gigabyte of zeros in a megabyte."""
    forged(folder, array("points", lambda old: np.zeros((10**6, 3))), compressed=True)


def pickled(folder: Path) -> None:
    """An array of objects, which a careless reader would execute."""
    whole = io.BytesIO()
    np.savez(whole, header=np.array([{"a": os.system}], dtype=object), allow_pickle=True)
    other_archive(whole.getvalue())(folder)


def other_archive(data: bytes) -> Callable[[Path], None]:
    """Anything in place of the archives."""

    def change(folder: Path) -> None:
        for path in folder.glob("checkpoint*"):
            path.write_bytes(data)

    return change


def empty_archive() -> bytes:
    """A zip without files."""
    whole = io.BytesIO()
    zipfile.ZipFile(whole, "w").close()
    return whole.getvalue()


def headed(head: bytes) -> bytes:
    """An archive with one array that begins so."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr(
            "header.npy", b"\x93NUMPY\x02\x00" + len(head).to_bytes(4, "little") + head
        )
    return whole.getvalue()


@pytest.mark.parametrize(
    "change",
    [other_archive(headed(b"(" * 9000 + b"\n")),
     bomb, pickled, other_archive(b"no archive"), other_archive(empty_archive()), other_archive(b"")],
)  # fmt: skip
def test_another_archive_is_refused(change: Callable[[Path], None], folder: Path) -> None:
    change(folder)
    before = content(folder)
    refusal_of("run", "--resume", folder, "--set", LONGER[0], "-q")
    assert content(folder) == before


def test_a_field_without_end_in_a_history_is_refused(folder: Path) -> None:
    text = (folder / "history.csv").read_text()
    (folder / "history.csv").write_text(text.replace("\n", '\n"' + "a" * 200_000 + '",', 1))
    assert "history.csv: field larger than" in refusal_of("status", folder)


@pytest.mark.parametrize("by", [10**9, -5])
def test_elements_of_nodes_that_are_not_there_are_refused(by: int, folder: Path) -> None:
    with h5py.File(folder / "fields.vtkhdf", "r+") as file:
        file["VTKHDF/Connectivity"][:] += by
    with pytest.raises(RecordingError, match="nodes that are not there"):
        _ = Recording(folder).elements


# ---------------------------------------------------------------- fields
def linked(kind: str) -> Callable[[Path, Path], None]:
    """fields.vtkhdf whose values are somewhere else."""

    def change(path: Path, victim: Path) -> None:
        with h5py.File(path, "r+") as file:
            shape = file["VTKHDF/PointData/displacement"].shape
            del file["VTKHDF/PointData/displacement"]
            group = file["VTKHDF/PointData"]
            if kind == "external link":
                group["displacement"] = h5py.ExternalLink(
                    str(victim), "/VTKHDF/PointData/displacement"
                )
            elif kind == "soft link":
                group["displacement"] = h5py.SoftLink("/VTKHDF/Points")
            elif kind == "external storage":
                storage = [(str(victim), 0, h5py.h5f.UNLIMITED)]
                group.create_dataset(
                    "displacement", shape, "f4", maxshape=(None, 3), external=storage
                )
            else:
                layout = h5py.VirtualLayout(shape, "f4")
                layout[:] = h5py.VirtualSource(str(victim), "x", shape)
                group.create_virtual_dataset("displacement", layout)

    return change


@pytest.mark.parametrize("kind", ["external link", "soft link", "external storage", "virtual"])
def test_fields_that_are_kept_elsewhere_are_refused(kind: str, folder: Path, victim: Path) -> None:
    linked(kind)(folder / "fields.vtkhdf", victim)
    before = content(folder)
    assert "fields.vtkhdf" in refusal_of("run", "--resume", folder, "--set", LONGER[0], "-q")
    assert content(folder) == before and victim.read_bytes() == MINE
    with contextlib.suppress(RecordingError):  # whoever reads them meets one line at most
        Recording(folder).fields(1.0)


@pytest.mark.parametrize("name", ["fields.vtkhdf", "fields_chains.vtkhdf"])
def test_a_flipped_bit_in_fields_is_noticed_before_anything_changes(
    name: str, folder: Path
) -> None:
    """HDF5's own check sums, and times and offsets, which follow from the numbers of nodes, elements and steps."""
    for place, wrong in (("Steps/Values", -1.0), ("Steps/PointDataOffsets/displacement", 7)):
        copy = shutil.copy(folder / name, folder.with_name("copy.vtkhdf"))
        with h5py.File(copy, "r+") as file:
            file[f"VTKHDF/{place}"][2] = wrong
        with pytest.raises(ValueError, match="is corrupt"):
            check_series(Path(copy))
    path = folder / name
    with h5py.File(path) as file:
        values = file["VTKHDF/PointData/displacement"]
        chunk = values.id.get_chunk_info(1)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(data)
    before = content(folder)
    with pytest.raises(RecordingError, match=f"{name}: is corrupt"):
        resume(folder, LONGER, SELF)
    assert content(folder) == before
    if name == "fields.vtkhdf":
        with pytest.raises(RecordingError, match="is corrupt"):
            for recorded in Recording(folder).times:
                Recording(folder).fields(recorded)


# ---------------------------------------------------------------- a folder that goes, or that is nobody's
def test_a_run_whose_folder_is_deleted_ends_with_5(tmp_path: Path) -> None:
    program = f"""
import shutil, sys
from remodel_fenicsx import cli
from remodel_fenicsx.results.run_folder import History
append = History.append
def append_and_delete(history, row):
    append(history, row)
    if row["time"] == 3.0:
        shutil.rmtree({str(tmp_path / "out")!r})
History.append = append_and_delete
sys.exit(cli.main(["run", {str(demo("cube"))!r}, "--set", "time.end=5", "-q", "-o", {str(tmp_path / "out")!r}]))
"""
    done = forked("python", program)
    assert done.returncode == 5 and done.stdout == "", (done.returncode, done.stdout, done.stderr)
    assert (
        done.stderr.count("\n") == 1
        and "was deleted during the run; lost: the rows of this run" in done.stderr
    )


def test_a_folder_with_nothing_but_a_dead_lock_is_nobodys(tmp_path: Path) -> None:
    """What a member of a study leaves that was killed before it wrote its scene."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.lock").write_text('{"number": 1, "host": "elsewhere", "ranks": 1}\n')
    assert choose_folder(tmp_path / "out", "x") == tmp_path / "out"
    done = run("run", demo("cube"), "--set", "time.end=1", "-q", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- the working folder, and what lies in it
def test_the_working_folder_runs_nothing_and_sets_nothing(tmp_path: Path) -> None:
    """Where a scene was unpacked there may be more: modules, and options of PETSc, dolfinx and FFCx."""
    put_there = {
        "numpy.py": "open('victim-of-module', 'w')",
        ".petscrc": "-log_view ascii:victim-of-log\n-remodel_snes_view ascii:victim-of-view\n",
        "petscrc": "-remodel_ksp_type python\n",
        "dolfinx_jit_options.json": '{"cffi_libraries": ["mine"], "no JSON',
        "ffcx_options.json": '{"scalar_type": "float32", "no JSON',
    }
    for name, text in put_there.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "scene.toml").write_text(pulled_cube(1.0).to_toml())
    words = "ensemble scene.toml --seeds 2 --jobs 1 -o out -q".split()
    command = [sys.executable, PROJECT / "bin" / "remodel-fenicsx", *words]
    own = {"PETSC_OPTIONS": "-remodel_snes_monitor ascii:the-users-own::append"}
    done = ran(command, cwd=tmp_path, env=os.environ | own)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {
        *put_there,
        "scene.toml",
        "out",
        "the-users-own",
    }


# ---------------------------------------------------------------- without end
@pytest.mark.parametrize("device", ["/dev/full", "/dev/zero", "/dev/stdin", "pipe"])
def test_a_device_or_a_pipe_is_no_scene(device: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    said = refusal_of("validate", tmp_path / device)
    assert "not a file" in said or device != "pipe" and "cannot be read" in said


@pytest.mark.parametrize("name", ["run.lock", "checkpoint-a.npz", "history.csv", "scene.toml",
                                  "fields.vtkhdf"])  # fmt: skip
def test_a_pipe_in_a_folder_keeps_nobody_waiting(name: str, folder: Path) -> None:
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    refusal_of("run", "--resume", folder, "--set", LONGER[0], "-q")
    assert "Traceback" not in run("status", folder).stderr


def test_a_scene_has_bounds(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    many = ".".join(["a"] * 200_000)
    quoted = ".".join(['"1"'] * 5000)
    for text, words in {
        f"{many} = 1": f"a key of more than {MOST_PARTS} parts",
        f"[{'.'.join(['1'] * 5000)}]": f"a key of more than {MOST_PARTS} parts",
        f"x = {{ {quoted} = 1 }}": f"a key of more than {MOST_PARTS} parts",
        f"x = {'[' * 150}{']' * 150}": f"more than {MOST_PARTS} nested tables",
        "x = 1 #" + " " * LARGEST: "is larger than 1 MB",
    }.items():
        path.write_text(text[: LARGEST - 1] if "larger" not in words else text)
        with pytest.raises(SceneError, match=words):
            read_scene(path)
    times = ", ".join(f"{whole}.5" for whole in range(20_000))  # decimals are no keys
    path.write_text(f"{demo('cube').read_text()}\n[output]\ntimes = [{times}]\n")
    with pytest.raises(SceneError, match="output.times"):
        read_scene(path)


@pytest.mark.parametrize(
    "words",
    [("run", "--set", ".".join(["a"] * 5000) + "=1"), ("ensemble", "--seeds", "1000000000"),
     ("stability", "--times", "1000000000"), ("trade", "--jobs", "1000000000")],
)  # fmt: skip
def test_numbers_on_the_command_line_have_bounds(words: tuple[str, ...], tmp_path: Path) -> None:
    done = run(words[0], demo("cube"), *words[1:], cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert (
        "must be an integer from 1 to 10000" in done.stderr or "more than 100 parts" in done.stderr
    )
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- Python
def test_numpys_numbers_are_numbers() -> None:
    scene = preset_scene("kuhl-holzapfel-2007", "cube")
    values = {"cells.seed": np.int64(3), "time.end": np.float32(3.0), "cells.initial": np.array([0.6, 0.8, 0.0]),
              "output.fields": np.bool_(False), "mesh.refinement": np.uint8(2)}  # fmt: skip
    plain = {"cells.seed": 3, "time.end": 3.0, "cells.initial": [0.6, 0.8, 0.0], "output.fields": False,
             "mesh.refinement": 2}  # fmt: skip
    assert scene.with_values(values) == scene.with_values(plain)
    assert tomllib.loads(scene.with_values(values).to_toml())["cells"]["seed"] == 3
    with pytest.raises(SceneError, match=r"cells\.seed = 1\.5"):
        scene.with_values({"cells.seed": np.float64(1.5)})


@pytest.mark.parametrize("scene", ["scene.toml", None, Path("scene.toml"), {"geometry": {}}])
def test_a_simulation_says_what_it_needs(scene: Any) -> None:
    with pytest.raises(TypeError, match=r"not a Scene: .*read_scene\(PATH\)"):
        Simulation(scene)


def test_no_step_after_the_end() -> None:
    with made(pulled_cube(3.0)) as simulation:
        steps = simulation.steps()
        next(steps)
    for after in (steps, simulation.steps()):
        with pytest.raises(RuntimeError, match="has been closed"):
            next(after)
