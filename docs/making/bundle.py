"""report.bundle.js and report.bundle.css, the code of others in reports, anew from their npm packages.

    python3 docs/make bundle            # writes both, and their check sums into VENDOR.toml
    python3 docs/make --check bundle    # says whether they are what VENDOR.toml's packages give, byte for byte

It needs npm (x86-64), and nothing of this project or its environment.
"""

from __future__ import annotations

import base64
import hashlib
import re
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from pathlib import Path

ASSETS = Path(__file__).parents[2] / "remodel_fenicsx" / "report" / "assets"
VENDOR = ASSETS / "VENDOR.toml"
BUNDLES = ("report.bundle.js", "report.bundle.css")
OPTIONS = (
    "--bundle",
    "--minify",
    "--format=iife",
    "--global-name=LIBRARIES",
    "--target=es2022",
    "--log-level=warning",
)


def fetched(name: str, version: str, integrity: str, folder: Path) -> Path:
    """A package of npm's, unpacked in the folder, if it is the one that is meant."""
    command = ["npm", "pack", "--silent", f"{name}@{version}"]
    file = (
        folder
        / subprocess.run(
            command, cwd=folder, check=True, capture_output=True, text=True
        ).stdout.split()[-1]
    )
    found = "sha512-" + base64.b64encode(hashlib.sha512(file.read_bytes()).digest()).decode()
    if found != integrity:
        sys.exit(f"{name} {version}: is {found}, VENDOR.toml has {integrity}")
    place = folder / "node_modules" / name
    with tarfile.open(file) as archive:
        archive.extractall(folder / name.replace("/", "-"), filter="data")
    place.parent.mkdir(parents=True, exist_ok=True)
    (folder / name.replace("/", "-") / "package").rename(place)
    return place


def built(folder: Path) -> dict[str, bytes]:
    """The bundles, by name."""
    vendor = tomllib.loads(VENDOR.read_text(encoding="utf-8"))
    for package in vendor["package"]:
        fetched(package["name"], package["version"], package["integrity"], folder)
    tool = vendor["builder"]
    esbuild = fetched(tool["name"], tool["version"], tool["integrity"], folder) / "bin" / "esbuild"
    esbuild.chmod(0o755)
    (folder / "bundle.entry.js").write_bytes((ASSETS / "bundle.entry.js").read_bytes())
    command = [str(esbuild), "bundle.entry.js", *OPTIONS, f"--outfile={BUNDLES[0]}"]
    subprocess.run(command, cwd=folder, check=True)
    return {name: (folder / name).read_bytes() for name in BUNDLES}


def check() -> bool:
    """Whether the bundles are what the packages give."""
    with tempfile.TemporaryDirectory() as folder:
        return all(
            data == (ASSETS / name).read_bytes() for name, data in built(Path(folder)).items()
        )


def make(keep: bool) -> None:
    """Both, and their check sums; there is nothing to keep."""
    text = VENDOR.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        for name, data in built(Path(folder)).items():
            (ASSETS / name).write_bytes(data)
            line = f'"{name}" = "{hashlib.sha256(data).hexdigest()}"'
            text = re.sub(rf'^"{name}" = .*$', line, text, flags=re.MULTILINE)
    VENDOR.write_text(text, encoding="utf-8")
