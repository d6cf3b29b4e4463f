"""./with-fenicsx: a copy of it in a clone of its own, real namespaces, and a root that a stand-in for mmdebstrap makes.

The stand-in's root holds links to this machine's own /usr and /etc, so that the real enter-root has real work to do.
No stand-in reaches the network, installs anything, or starts a container.
"""

import atexit
import functools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import pytest

from tests.processes import ran


pytestmark = pytest.mark.launcher
PROJECT = Path(__file__).resolve().parents[2]
LONG = 200  # seconds, for what takes a few on an idle machine
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

MAPPED = (
    [] if os.getuid() == 0 else ["--user", "--map-root-user"]
)  # of unshare(1), for a namespace to mount in
STAND_INS = Path(__file__).parent / "stand_ins"  # for programs that reach the network or mount


def script(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@functools.cache
def mount_command() -> Path:
    """A program like mount(8), compiled once."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    subprocess.run(["gcc", STAND_INS / "mount.c", "-o", folder / "mount"], check=True)
    return folder / "mount"


class Clone:
    """A copy of the launcher in a folder whose name has a space, with an empty cache and stand-ins on the PATH."""

    def __init__(self, folder: Path, cache: Path | None = None):
        self.folder = folder / "a clone"
        self.cache = cache or folder / "cache"
        self.record = folder / "record"
        stubs = folder / "stubs"
        for made in (self.folder, self.record, folder / "home"):
            made.mkdir(parents=True)
        shutil.copy(PROJECT / "with-fenicsx", self.folder)
        shutil.copytree(PROJECT / "environment", self.folder / "environment")
        shutil.copy(PROJECT / "Dockerfile", self.folder)
        self.launcher = self.folder / "with-fenicsx"
        self.packages = self.folder / "environment" / "debian-packages.txt"
        self.stubs = stubs
        stubs.mkdir()
        shutil.copy(STAND_INS / "mmdebstrap", stubs)
        script(stubs / "newuidmap", "#!/bin/sh\nexit 1\n")
        script(
            stubs / "apt-get",
            '#!/bin/sh\necho "$*" >> "$RECORD/apt-get"; echo "E: no network" >&2; exit 100\n',
        )
        for engine in ("docker", "podman"):
            shutil.copy(STAND_INS / "engine", stubs / engine)
        if not shutil.which("mount", path=SYSTEM_PATH):
            (self.folder / "bin").mkdir()
            shutil.copy(mount_command(), self.folder / "bin" / "mount")
        self.environment = {
            "PATH": f"{stubs}:{self.folder}/bin:{SYSTEM_PATH}",
            "HOME": str(folder / "home"),
            "LANG": "C.UTF-8",
            "XDG_CACHE_HOME": str(self.cache),
            "RECORD": str(self.record),
            "WITH_FENICSX": "root",
            "STUB_ENGINE": "none",
        }

    def start(self, *command: str, **options):
        environment = self.environment | options.pop("environment", {})
        environment = {name: value for name, value in environment.items() if value is not None}
        options = {
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
        } | options
        words = [options.pop("launcher", self.launcher), *command]
        return subprocess.Popen(
            words, env=environment, text=True, start_new_session=True, **options
        )

    def run(self, *command: str, send: str | None = None, **options):
        if send is not None:
            options["stdin"] = subprocess.PIPE
        process = self.start(*command, **options)
        out, err = process.communicate(send, timeout=LONG)
        return subprocess.CompletedProcess(command, process.returncode, out, err)

    def building(self, way: str, **environment: str):
        """A start whose build is under way, "held" until it may go on, or "hang"."""
        process = self.start("echo", "first", environment=environment | {"STUB_BUILD": way})
        wait_for((self.record / "begun").exists, "the build")
        return process

    def kill_builder(self) -> None:
        """With all that it has started."""
        os.killpg(os.getpgid(int((self.record / "pid").read_text())), signal.SIGKILL)

    def builds(self) -> list[list[str]]:
        record = self.record / "mmdebstrap"
        return (
            [call.split("\n") for call in record.read_text().split("\n----\n")[:-1]]
            if record.exists()
            else []
        )

    def roots(self) -> list[str]:
        return sorted(
            path.name for path in (self.cache / "remodel-fenicsx").iterdir() if path.is_dir()
        )

    def engine_calls(self) -> list[list[str]]:
        return [json.loads(line) for line in (self.record / "engine").read_text().splitlines()]


def wait_for(condition, what: str) -> None:
    deadline = time.monotonic() + LONG
    while time.monotonic() < deadline:
        if condition():
            return
        time.sleep(0.05)
    pytest.fail(f"after {LONG} s still waiting for {what}")


def one_line(result, words: str) -> None:
    """The launcher's own, exit status 5."""
    assert (result.returncode, result.stderr.count("\n")) == (5, 1), result.stderr
    assert result.stderr.startswith("with-fenicsx: ") and words in result.stderr, result.stderr


def namespaces_work(clone: Clone) -> bool:
    words = [
        "unshare",
        *MAPPED,
        "--mount",
        "--propagation",
        "private",
        "mount",
        "--bind",
        "/usr",
        "/usr",
    ]
    tried = shutil.which("unshare") and subprocess.run(
        words, env=clone.environment, capture_output=True
    )
    return bool(tried) and tried.returncode == 0


@pytest.fixture
def clone(tmp_path):
    return Clone(tmp_path)


@pytest.fixture
def rooted(clone):
    if not namespaces_work(clone):
        pytest.skip("this machine allows no mount namespaces")
    return clone


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """A clone whose root is made already: for tests that change nothing in it."""
    clone = Clone(tmp_path_factory.mktemp("ready"))
    if not namespaces_work(clone):
        pytest.skip("this machine allows no mount namespaces")
    assert clone.run("true").returncode == 0
    return clone


# ---------------------------------------------------------------- the command is as if it ran here
@pytest.mark.parametrize("code", [0, 5, 127, 130])
def test_exit_status_is_the_commands(ready, code):
    result = ready.run(*("sh", "-c", f"exit {code}") if code != 127 else ("no-such-command",))
    assert (result.returncode, result.stdout) == (code, "")


def test_arguments_and_standard_input(ready):
    arguments = ["a b", "", "line\nbreak", "*", "-v", "$HOME", "q'\"\\"]
    program = "import json, sys; print(json.dumps([sys.argv[1:], sys.stdin.read()]))"
    result = ready.run("python3", "-c", program, *arguments, send="one\n\ntwo")
    assert json.loads(result.stdout) == [arguments, "one\n\ntwo"]
    assert result.stderr == ""


@pytest.mark.parametrize("where", ["/var/tmp", "/dev/shm", "/tmp"])
def test_working_folder_and_owner(ready, where):
    folder = Path(
        subprocess.check_output(["mktemp", "-d", f"{where}/with fenicsx.XXXXXX"], text=True).strip()
    )
    try:
        result = ready.run("sh", "-c", "pwd; echo data > file", cwd=folder)
        assert (result.returncode, result.stdout.strip()) == (0, str(folder))
        assert (folder / "file").read_text() == "data\n"
        assert (folder / "file").stat().st_uid == os.getuid()
    finally:
        shutil.rmtree(folder)


def test_through_a_link_from_elsewhere(ready, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(ready.launcher)
    result = ready.run("sh", "-c", 'echo "$PYTHONPATH"; pwd', launcher=link, cwd=tmp_path)
    assert result.stdout.splitlines() == [str(ready.folder), str(tmp_path)]


def test_process_is_the_command_and_gets_its_signals(ready):
    for number in (signal.SIGINT, signal.SIGTERM):
        process = ready.start(
            "python3", "-c", "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
        )
        assert int(process.stdout.readline()) == process.pid
        os.killpg(process.pid, number)
        process.communicate(timeout=LONG)
        assert process.returncode == -number


def test_nothing_stays_mounted(ready):
    inside = ready.run("cat", "/proc/self/mountinfo").stdout
    assert f"{ready.cache.name}/remodel-fenicsx" in inside or " /usr ro" in inside
    assert str(ready.cache) not in Path("/proc/self/mountinfo").read_text()


def test_another_python_does_not_reach_in(ready):
    foreign = dict.fromkeys(
        "PYTHONPATH PYTHONHOME PYTHONWARNINGS PYTHONINSPECT PYTHONOPTIMIZE PYTHONPLATLIBDIR PYTHONDEVMODE "
        "VIRTUAL_ENV CONDA_PREFIX LD_LIBRARY_PATH CC CFLAGS PETSC_DIR BASH_ENV".split(),
        "/nowhere",
    )
    fake = ready.stubs.parent / "conda"
    script(fake / "python3", "#!/bin/sh\nexit 99\n")
    environment = foreign | {"PATH": f"{fake}:{ready.environment['PATH']}", "KEPT": "yes"}
    program = "import json, os; print(json.dumps(dict(os.environ)))"
    result = ready.run("python3", "-c", program, environment=environment)
    inside = json.loads(result.stdout)
    assert inside["KEPT"] == "yes"
    assert inside["PYTHONPATH"] == str(ready.folder)
    assert [name for name in foreign if name != "PYTHONPATH" and name in inside] == []
    assert "WITH_FENICSX" not in inside  # a command that calls the launcher again is inside already


def test_ranks_must_start_inside(ready):
    for name in ("OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS"):
        one_line(
            ready.run("true", environment={name: "2"}),
            "must start inside: ./with-fenicsx mpirun -n 2 true\n",
        )
    assert (
        ready.run("true", environment={"SLURM_NTASKS": "2", "SLURM_STEP_NUM_TASKS": "1"}).returncode
        == 0
    )


# ---------------------------------------------------------------- making the root
def test_made_once_from_the_list(rooted):
    first = rooted.run("cat", send="made\n")
    assert (first.returncode, first.stdout) == (0, "made\n")
    assert (
        "making a Debian trixie environment" in first.stderr
        and "downloading packages" in first.stderr
    )
    second = rooted.run("echo", "again")
    assert (second.returncode, second.stdout, second.stderr) == (0, "again\n", "")
    (arguments,) = rooted.builds()
    (included,) = [
        argument.removeprefix("--include=")
        for argument in arguments
        if argument.startswith("--include=")
    ]
    lines = [line.split("#")[0].strip() for line in rooted.packages.read_text().splitlines()]
    assert included.split(",") == [line for line in lines if line]
    assert "trixie" in arguments


@pytest.fixture
def with_demos(rooted):
    """A clone with two demos, and a stand-in for the command that runs them."""
    (rooted.folder / "demos").mkdir()
    for name in ("one", "two"):
        (rooted.folder / "demos" / f"{name}.toml").touch()
    (rooted.folder / "bin").mkdir(exist_ok=True)
    shutil.copy(STAND_INS / "remodel-fenicsx", rooted.folder / "bin")
    return rooted


def test_a_new_environment_compiles_what_the_demos_need(with_demos):
    assert with_demos.run("echo", "done").stdout == "done\n"
    assert with_demos.run("true").stderr == ""
    first, second = (with_demos.record / "demos").read_text().splitlines()
    assert (
        first.startswith(f"run {with_demos.folder}/demos/one.toml --no-report ")
        and "two.toml" in second
    )
    folder = Path(first.split(" -o ")[1]).parent
    assert not folder.exists() and not folder.is_relative_to(with_demos.folder)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_compilation_outlives_the_launcher(with_demos, number):
    process = with_demos.start("true", environment={"STUB_DEMO": "hang"}, stderr=subprocess.DEVNULL)
    wait_for((with_demos.record / "demo-process").exists, "the run of a demo")
    wait_for((with_demos.record / "demo-process").read_text, "its number")
    demo = Path("/proc") / (with_demos.record / "demo-process").read_text().strip()
    os.kill(process.pid, number)
    process.wait(timeout=LONG)
    wait_for(lambda: not demo.exists(), "the end of the demo")
    assert len((with_demos.record / "demos").read_text().splitlines()) == 1


def test_key_is_the_list_and_the_release(rooted):
    rooted.run("true")
    rooted.packages.write_text(rooted.packages.read_text() + "# a comment changes nothing\n\n")
    rooted.run("true")
    assert len(rooted.roots()) == 1
    rooted.packages.write_text(rooted.packages.read_text() + "one-more\n")
    rooted.run("true")
    assert len(rooted.roots()) == 2
    rooted.run("true", environment={"WITH_FENICSX_SUITE": "unstable"})
    assert [name.split("-")[0] for name in rooted.roots()] == ["trixie", "trixie", "unstable"]
    assert any("Check-Valid-Until" in argument for argument in rooted.builds()[-1])


def test_two_clones_at_once_make_one(rooted, tmp_path):
    other = Clone(tmp_path / "other", cache=rooted.cache)
    first = rooted.building("held")
    second = other.start("echo", "second")
    assert (
        second.stderr.readline()
        == "with-fenicsx: another run is making the environment: waiting for it\n"
    )
    (rooted.record / "go").touch()
    assert second.communicate(timeout=LONG)[0] == "second\n"
    assert second.returncode == 0
    assert first.communicate(timeout=LONG)[0] == "first\n"
    assert (len(rooted.builds()), len(other.builds())) == (1, 0)


@pytest.mark.parametrize(
    "number, group", [(signal.SIGINT, True), (signal.SIGTERM, False), (signal.SIGHUP, False)]
)
def test_build_ends_with_the_launcher(rooted, number, group):
    process = rooted.building("hang")
    (os.killpg if group else os.kill)(process.pid, number)
    process.communicate(timeout=LONG)
    assert process.returncode == 128 + number
    builder = int((rooted.record / "pid").read_text())
    wait_for(lambda: not Path(f"/proc/{builder}").exists(), "the end of mmdebstrap")
    assert rooted.roots() == []
    assert rooted.run("true").returncode == 0
    assert len(rooted.builds()) == 2


def a_user_builds(rooted, tmp_path) -> dict[str, str]:
    """The environment in which the launcher takes the way of one who is not root: the root comes as a tar stream."""
    script(rooted.stubs / "id", "#!/bin/sh\necho 1000\n")
    if os.getuid() == 0:  # who may mount already needs no user namespace for it
        real = shutil.which("unshare", path=SYSTEM_PATH)
        script(
            rooted.stubs / "unshare",
            f'#!/bin/bash\nshopt -s extglob\nexec {real} "${{@/--@(user|map-root-user)/--mount}}"\n',
        )
    (tmp_path / "temporary").mkdir()
    return {"TMPDIR": str(tmp_path / "temporary")}


def killed_build(rooted, environment: dict[str, str]) -> Path:
    """Launcher and builder end by SIGKILL in the middle; the temporary folder that is left."""
    process = rooted.building("hang", **environment)
    process.kill()
    process.wait()
    rooted.kill_builder()
    (lock,) = (rooted.cache / "remodel-fenicsx").glob("*.lock")
    wait_for(
        lambda: subprocess.run(["flock", "-n", lock, "true"]).returncode == 0,
        "the end of all that held the lock",
    )
    (left,) = Path(environment["TMPDIR"]).glob("remodel-fenicsx-build-*")
    assert list(left.glob("*/half"))
    # as owned by a mapped user: rm alone does not get rid of it
    script(
        rooted.stubs / "rm",
        f"""#!/bin/bash
shopt -s nullglob; rest=({left}/*/*)
[ ${{#rest[@]}} = 0 ] || [ "${{!#}}" != {left} ] || exit 1
exec {shutil.which("rm", path=SYSTEM_PATH)} "$@"
""",
    )
    return left


@pytest.mark.parametrize("other_list", [False, True])
def test_the_next_start_removes_what_a_killed_build_left(rooted, tmp_path, other_list):
    environment = a_user_builds(rooted, tmp_path)
    left = killed_build(rooted, environment)
    (part,) = rooted.roots()
    if other_list:
        rooted.packages.write_text(rooted.packages.read_text() + "one-more\n")
    after = rooted.run("echo", "after", environment=environment)
    assert (after.returncode, after.stdout) == (0, "after\n"), after.stderr
    assert "with-fenicsx: removing what a build that was killed has left of " in after.stderr
    assert part not in rooted.roots() and len(rooted.roots()) == 1
    assert list((tmp_path / "temporary").iterdir()) == []
    assert (rooted.record / "helper").read_text() == f"find {left} -mindepth 2 -xdev -delete\n"
    assert list((rooted.cache / "remodel-fenicsx").glob("*.building")) == []
    assert rooted.run("true", environment=environment).stderr == ""


@pytest.mark.parametrize("damage", ["empty", "without /etc", "file"])
def test_an_environment_that_is_not_whole_is_made_anew(rooted, damage):
    assert rooted.run("true").returncode == 0
    (root,) = (path for path in (rooted.cache / "remodel-fenicsx").iterdir() if path.is_dir())
    (root / "etc").unlink()
    if damage != "without /etc":
        shutil.rmtree(root)
        root.mkdir() if damage == "empty" else root.touch()
    healed = rooted.run("echo", "in")
    assert (healed.returncode, healed.stdout) == (0, "in\n"), healed.stderr
    assert healed.stderr.startswith(f"with-fenicsx: {root} is not whole: making it anew\n")
    assert rooted.run("true").stderr == ""
    assert rooted.roots() == [root.name]


def test_failed_build(rooted):
    result = rooted.run("true", environment={"STUB_BUILD": "fail"})
    assert result.returncode == 5
    assert "E: no such mirror" in result.stderr.splitlines()[-1]
    assert rooted.roots() == []


def test_no_space(rooted):
    script(rooted.stubs / "df", "#!/bin/sh\nprintf 'Avail\\n1000000\\n'\n")
    one_line(rooted.run("true"), "1 GB are free")
    assert rooted.builds() == []


def test_host_tools_missing(rooted):
    (rooted.stubs / "mmdebstrap").unlink()
    if shutil.which("mmdebstrap", path=SYSTEM_PATH):
        pytest.skip("this machine has mmdebstrap")
    result = rooted.run("true")
    assert result.returncode == 5
    line = "apt-get update && apt-get install --yes --no-install-recommends mmdebstrap"
    assert line in result.stderr
    assert (rooted.record / "apt-get").exists() == (os.getuid() == 0)


def test_older_roots_are_pruned_unless_in_use(rooted):
    original = rooted.packages.read_text()
    busy = rooted.start("sh", "-c", "echo in; read line", stdin=subprocess.PIPE)
    assert busy.stdout.readline() == "in\n"
    (used,) = rooted.roots()
    keys = []
    for number in range(1, 4):
        time.sleep(0.02)
        rooted.packages.write_text(f"{original}package-{number}\n")
        assert rooted.run("true").returncode == 0
        keys += [name for name in rooted.roots() if name not in [used, *keys]]
    assert rooted.roots() == sorted(
        [used, *keys[1:]]
    )  # four were made; the oldest is old, but in use
    busy.communicate("\n")
    assert busy.returncode == 0
    rooted.packages.write_text(f"{original}package-4\n")
    rooted.run("true")
    assert used not in rooted.roots() and len(rooted.roots()) == 2


# ---------------------------------------------------------------- what cannot work says so in one line
@pytest.mark.parametrize(
    "environment, words",
    [
        ({"XDG_CACHE_HOME": "some/where"}, "XDG_CACHE_HOME=some/where: must be an absolute path"),
        (
            {"XDG_CACHE_HOME": "/dev/null"},
            "cannot write to /dev/null/remodel-fenicsx: set XDG_CACHE_HOME",
        ),
        (
            {"XDG_CACHE_HOME": None, "HOME": "/dev/null"},
            "cannot write to /dev/null/.cache/remodel-fenicsx",
        ),
        ({"WITH_FENICSX": "magic"}, "WITH_FENICSX=magic: allowed are native, root and container"),
        ({"WITH_FENICSX_SUITE": "sid"}, "WITH_FENICSX_SUITE=sid: allowed are trixie and unstable"),
        ({"WITH_FENICSX_ADD": "window"}, "WITH_FENICSX_ADD=window: allowed is browser"),
        ({"WITH_FENICSX_ADD": "../x"}, "WITH_FENICSX_ADD=../x: allowed is browser"),
        (
            {"WITH_FENICSX": "container"},
            "WITH_FENICSX=container: neither docker nor podman can start a container",
        ),
    ],
)
def test_one_line_and_exit_5(rooted, environment, words):
    one_line(rooted.run("true", environment=environment), f"with-fenicsx: {words}")
    assert rooted.builds() == []


@pytest.mark.parametrize("way", ["root", None])
def test_no_namespaces(clone, way):
    script(clone.stubs / "unshare", "#!/bin/sh\nexit 1\n")
    script(clone.stubs / "python3", "#!/bin/sh\nexit 1\n")
    words = "this machine lets you mount nothing" if way else ""
    one_line(clone.run("true", environment={"WITH_FENICSX": way}), words)


# ---------------------------------------------------------------- native
@pytest.mark.parametrize("version, suite, usable", [
    ("0.9.0", None, True), ("0.9.0", "trixie", True), ("0.9.0", "unstable", False), ("0.5.2", None, False),
    ("0.11.0.post0", None, True), ("0.11.0.post0", "trixie", False), ("0.11.0.post0", "unstable", True),
])  # fmt: skip
def test_native_version(clone, tmp_path, version, suite, usable):
    for name in "dolfinx mpi4py petsc4py gmsh pydantic pint tomlkit h5py rich scipy meshio".split():
        script(
            tmp_path / "site" / name / "__init__.py",
            "raise SystemExit('the launcher must not import this')",
        )
    script(
        tmp_path / "site" / f"fenics_dolfinx-{version}.dist-info" / "METADATA",
        f"Metadata-Version: 2.1\nName: fenics-dolfinx\nVersion: {version}\n",
    )
    environment = {
        "WITH_FENICSX": "native",
        "PYTHONPATH": str(tmp_path / "site"),
        "WITH_FENICSX_SUITE": suite,
    }
    result = clone.run("sh", "-c", 'echo "$PYTHONPATH"; exit 7', environment=environment)
    assert result.returncode == (7 if usable else 5)
    assert result.stdout == (f"{clone.folder}:{tmp_path / 'site'}\n" if usable else "")


def test_inside_an_environment_it_is_native():
    """This very test runs where dolfinx is: the launcher must take it as it is, silently."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("WITH_FENICSX")
    }
    result = ran([PROJECT / "with-fenicsx", "-v", "sh", "-c", "echo inside"], env=environment)
    assert (result.returncode, result.stdout) == (0, "inside\n")
    assert (
        result.stderr
        == f"with-fenicsx: running in this machine's own Python ({shutil.which('python3')})\n"
    )


# ---------------------------------------------------------------- a container engine
def test_container(clone, tmp_path):
    environment = {
        "WITH_FENICSX": "container",
        "STUB_ENGINE": "able",
        "KEPT": "yes",
        "LD_LIBRARY_PATH": "/x",
    }
    assert clone.run("some", "a b", cwd=tmp_path, environment=environment).returncode == 0
    calls = clone.engine_calls()
    assert [call[:2] for call in calls] == [
        ["docker", word] for word in ("image", "run", "build", "run")
    ]
    build, run = calls[2], calls[3]
    assert build[build.index("--target") + 1] == "environment" and build[-1] == str(clone.folder)
    image = build[build.index("-t") + 1]
    assert run[-3:] == [image, "some", "a b"]
    pairs = list(zip(run, run[1:]))
    assert ("--user", f"{os.getuid()}:{os.getgid()}") in pairs and (
        "--workdir",
        str(tmp_path),
    ) in pairs
    for folder in (tmp_path, clone.folder, clone.environment["HOME"]):
        assert ("--volume", f"{folder}:{folder}") in pairs
    assert ("--env", "KEPT") in pairs and ("--env", "LD_LIBRARY_PATH") not in pairs


def test_a_temporary_folder_that_is_none_is_said(ready):
    one_line(
        ready.run("true", environment={"TMPDIR": "/etc/passwd"}), "TMPDIR=/etc/passwd: is no folder"
    )
