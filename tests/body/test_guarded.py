"""Files of meshes that would hang, unfold, lead elsewhere or lose a part: one line, in little time and memory."""

from __future__ import annotations

import base64
import os
import resource
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest

from remodel_fenicsx.body.mesh_file import read_mesh
from remodel_fenicsx.errors import UnreadableFile
from remodel_fenicsx.system import children as guarded

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)


def good(path: Path) -> Path:
    """A tetrahedron with its number."""
    meshio.Mesh(
        POINTS, [("tetra", [[0, 1, 2, 3]])], cell_data={"medit:ref": [np.array([1])]}
    ).write(
        path,
        **(
            {"binary": False}
            if path.suffix == ".vtu"
            else {"data_format": "XML"} if path.suffix == ".xdmf" else {}
        ),
    )
    return path


def changed(path: Path, old: str, new: str) -> None:
    text = path.read_bytes()
    assert old.encode() in text
    path.write_bytes(text.replace(old.encode(), new.encode(), 1))


def utf16(path: Path) -> None:
    path.write_bytes(path.read_text().replace("utf-8", "utf-16").encode("utf-16"))


def in_hdf5(path: Path) -> None:
    """As UTF-16, which a look for words in the bytes does not see."""
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["points"] = POINTS
    text = path.read_text()
    start, end = text.index("<DataItem"), text.index("</DataItem>")
    item = (
        '<DataItem DataType="Float" Dimensions="4 3" Format="HDF" Precision="8">'
        + f"{path.stem}.h5:/points"
    )
    path.write_bytes((text[:start] + item + text[end:]).encode("utf-16"))


def pipe(path: Path) -> None:
    os.mkfifo(path.with_name("pipe"))
    in_hdf5(path)
    path.write_text(
        path.read_text("utf-16")
        .replace(f"{path.stem}.h5", "pipe")
        .replace('Format="HDF"', "Format='Binary'")
    )


def block_size(path: Path) -> None:
    """Of compressed values: -8."""
    head = base64.b64encode(struct.pack("<qqq", -8, 8, 8)).decode()
    vtk = (
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="%s" '
    )
    vtk += 'compressor="vtkZLibDataCompressor">'
    body = '<UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1"><Points>'
    body += '<DataArray type="Float64" NumberOfComponents="3" format="binary">'
    path.write_text(
        f"{vtk % 'Int64'}{body}{head}</DataArray></Points></Piece></UnstructuredGrid></VTKFile>"
    )


def endless(path: Path) -> None:
    """The same as an unsigned number: 2^64 - 8 blocks."""
    block_size(path)
    changed(path, "Int64", "UInt64")


def bomb(path: Path) -> None:
    """6 MB that unfold to 6 GiB."""
    size = 6 * 2**30 // 96
    packed = zlib.compress(bytes(size), 9)
    head = base64.b64encode(
        struct.pack("<Q", 96) + struct.pack("<QQ", size, 0) + struct.pack("<Q", len(packed)) * 96
    )
    data = base64.b64encode(packed * 96)
    block_size(path)
    text = path.read_text().replace("Int64", "UInt64")
    start, end = text.index('binary">') + len('binary">'), text.index("</DataArray>")
    path.write_bytes(text[:start].encode() + head + data + text[end:].encode())


def pieces(path: Path) -> None:
    text = path.read_text()
    start, end = text.index("<Piece"), text.index("</Piece>") + len("</Piece>")
    path.write_text(text[:end] + text[start:end] + text[end:])


def included(path: Path) -> None:
    changed(
        path,
        "<Domain>",
        '<Domain><xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd"/>',
    )


def of_type(number: int) -> Callable[[Path], None]:
    """By VTK's number of it."""

    def change(path: Path) -> None:
        text = path.read_text()
        start = text.index(">", text.index('Name="types"')) + 1
        path.write_text(f"{text[:start]}{number}{text[text.index('</DataArray>', start) :]}")

    return change


CASES: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "utf-16": (".xdmf", utf16, "not XML in UTF-8"),
    "values in HDF5": (".xdmf", in_hdf5, "not XML in UTF-8"),
    "a pipe": (".xdmf", pipe, "in another file"),
    "an entity": (".xdmf", lambda path: changed(path, "<Xdmf", '<!DOCTYPE a [<!ENTITY b "c">]><Xdmf'), "document type"),
    "included": (".xdmf", included, "another"),
    "a count of -1 in XDMF": (".xdmf", lambda path: changed(path, 'Dimensions="4 3"', 'Dimensions="-1 3"'), "negative"),
    "a count of -1 in VTK": (".vtk", lambda path: changed(path, "POINTS 4", "POINTS -1"), "negative"),
    "block size -8": (".vtu", block_size, "header_type = 'Int64': must be"),
    "endless blocks": (".vtu", endless, "cannot be read"),
    "a bomb": (".vtu", bomb, "takes more than 1[0-9]{3} MB to read|cannot be read: "),
    "pieces": (".vtu", pieces, "several pieces, must have one: .*ParaView"),
    "a polyhedron": (".vtu", of_type(42), "of type 'polyhedron'; must be"),
    "an unknown element": (".vtu", of_type(99), "missing or unknown: 99"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each by its own rule: what the library would say of it is another matter."""
    if name in ("utf-16", "a bomb"):  # whose memory is looked at
        monkeypatch.setattr(guarded, "subprocess", subprocess)
    monkeypatch.setattr(guarded, "SECONDS", 3.0)
    ending, change, rule = CASES[name]
    path = good(tmp_path / f"mesh{ending}")
    assert len(read_mesh(path).cells) == 1
    change(path)
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    with pytest.raises(UnreadableFile, match=rule) as refusal:
        read_mesh(path)
    words = str(refusal.value)
    assert len(words) < 300 and "\n" not in words and "Traceback" not in words, words
    assert time.monotonic() - began < guarded.WAITING * guarded.SECONDS
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss < max(before + 1, 2 * 10**6)  # kB


def test_a_long_complaint_is_cut(tmp_path: Path) -> None:
    path = good(tmp_path / "mesh.vtu")
    changed(path, 'Name="connectivity"', f'Name="{"c" * 20000}"')
    changed(path, "<Cells>", f"<{'x' * 20000}/><Cells>")
    with pytest.raises(UnreadableFile) as refusal:
        read_mesh(path)
    assert len(str(refusal.value)) < 300


def test_what_a_reader_warns_of_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that leaves something out says so on its own; a mesh without it is another one."""
    monkeypatch.setattr(guarded, "subprocess", subprocess)
    path = good(tmp_path / "mesh.vtu")
    with pytest.raises(guarded.UnreadableFile, match="left out"):
        guarded.read_guarded(path, f"{__name__}:reader_that_warns")


def reader_that_warns(file: str) -> dict[str, object]:
    print("some elements are left out", file=sys.stderr)
    return {}


READERS = {
    "opens": "another file",
    "opens_hdf5": "in another file",
    "connects": "outside the file",
    "starts": "outside the file",
    "never_ends": "takes more than 1 seconds",
    "takes_memory": "MB to read",
}


@pytest.mark.parametrize("reader", READERS)
def test_a_new_reader_has_the_limits(
    reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if reader in ("never_ends", "takes_memory"):
        monkeypatch.setattr(guarded, "subprocess", subprocess)
    monkeypatch.setattr(guarded, "SECONDS", 1.0 if reader == "never_ends" else 2.0)
    path, began = good(tmp_path / "mesh.vtu"), time.monotonic()
    with pytest.raises(guarded.UnreadableFile, match=READERS[reader]):
        guarded.read_guarded(path, f"{__name__}:{reader}")
    assert time.monotonic() - began < guarded.WAITING * guarded.SECONDS


def test_a_reader_that_waits_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes no processor time."""
    monkeypatch.setattr(guarded, "subprocess", subprocess)
    monkeypatch.setattr(guarded, "WAITING", 0.2)
    with pytest.raises(guarded.UnreadableFile, match="takes more than"):
        guarded.read_guarded(good(tmp_path / "mesh.vtu"), f"{__name__}:waits")


def waits(file: str) -> dict[str, object]:
    time.sleep(100)
    return {}


def opens_hdf5(file: str) -> dict[str, object]:
    import h5py as imported

    return {"read": np.array(imported.File("/etc/passwd"))}


def opens(file: str) -> dict[str, object]:
    return {"text": np.frombuffer(Path("/etc/passwd").read_bytes(), np.uint8)}


def connects(file: str) -> dict[str, object]:
    import socket

    socket.socket().connect(("127.0.0.1", 1))
    return {}


def starts(file: str) -> dict[str, object]:
    import subprocess

    subprocess.run(["true"])
    return {}


def never_ends(file: str) -> dict[str, object]:
    while True:
        pass


def takes_memory(file: str) -> dict[str, object]:
    return {"zeros": np.zeros(10**9)}
