"""Ctrl-C ends every command with a message and without a traceback, also while its libraries are loaded."""

import os
import re
import subprocess
import sys
import time

import pytest
import warm
from commands import HERE, ROOT, python

from cloning.base import cores, progress
from cloning.base.outputs import as_typed
from cloning.base.program import FAILED, in_commands

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="there SIGINT goes to a whole console")

# Some libraries turn an exception that is raised while they load into an error of their own.
INTERRUPTED_LIBRARY = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
except BaseException:
    raise ImportError("initialization failed")
"""

INSTALLED = ("-c", "import cloning.command as c; c.main()")  # the command of an installed project

# Those that a user calls; the other modules in tools/ are parts of them.
TOOLS = [
    path.stem for path in sorted((ROOT / "tools").glob("*.py")) if "= command_line(" in path.read_text(encoding="utf-8")
]


def run(*words, modules="") -> subprocess.CompletedProcess[str]:
    """A command of this Python in a process of its own; modules: a folder that shadows libraries."""
    environment = {**os.environ, "PYTHONPATH": str(modules)}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize(
    ("program", "library", "command"),
    [
        ("model.py", "numpy", ["model.py"]),
        ("drive.py", "numpy", ["drive.py"]),
        ("video.py", "numpy", ["video.py", "run1"]),
        ("simulator", "numpy", ["-m", "simulator", "record", "data"]),
        ("simulator", "panda3d", ["-m", "simulator", "drive"]),
        ("simulator", "torch", ["-m", "simulator", "replay", "RECORDING", "--model", "model.pt"]),
        ("video.py", "torch", ["video.py", "run1", "--overlay", "model.pt"]),
        ("export", "onnx", ["-m", "cloning.network.export", "cloning/network/shipped.pt", "none.onnx"]),
        ("behavioral-cloning browse", "flask", [*INSTALLED, "browse"]),
        ("browse", "numpy", ["-m", "cloning.browse"]),
        *((tool, "numpy", ["-m", f"tools.{tool}"]) for tool in TOOLS),
    ],
)
def test_ctrl_c_while_the_libraries_are_loaded(tmp_path, sample_recording, program, library, command):
    (tmp_path / f"{library}.py").write_text(INTERRUPTED_LIBRARY, encoding="utf-8")
    done = run(*(str(sample_recording) if word == "RECORDING" else word for word in command), modules=tmp_path)
    assert done.returncode == 130
    assert done.stderr.startswith(f"{program}: stopped") and done.stderr.count("\n") == 1


def test_no_library_is_loaded_before_ctrl_c_has_its_handler():
    """Each millisecond there is one in which Ctrl-C would give a traceback."""
    code = (
        "import sys; before = {*sys.modules, *sys.builtin_module_names}; from cloning.base import program\n"
        "print(*{*sys.modules} - before)"
    )
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    assert {*done.stdout.split()} <= {"cloning", "cloning.base", "cloning.base.program", "__future__", "atexit"}


LOADING_MAIN = """
from cloning.base import program
program.end_on_interrupt("test")
def main():
    try:
        import large
    finally:
        print("cleaned up", flush=True)
    print("not stopped")
program.run(main)
"""


@pytest.mark.parametrize(
    ("library", "printed"),
    [
        ("try:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept BaseException:\n    pass", ["cleaned up"]),
        ("os.kill(os.getpid(), signal.SIGINT)\nwhile True:\n    (lambda: time.sleep(0.01))()", []),
    ],
    ids=["that drops it", "that takes long"],
)
def test_ctrl_c_while_main_loads_a_library(tmp_path, library, printed):
    (tmp_path / "large.py").write_text(f"import os, signal, time\n{library}", encoding="utf-8")
    done = run("-c", LOADING_MAIN, modules=tmp_path)
    assert (done.returncode, done.stdout.splitlines(), done.stderr) == (130, printed, "test: stopped\n")


@pytest.mark.parametrize(
    ("program", "library", "command", "remedy"),
    [
        ("model.py", "torch", ["model.py"], "pip install torch"),
        ("drive.py", "torch", ["drive.py"], "pip install torch"),
        ("video.py", "cv2", ["video.py", "run1"], "pip install opencv-python-headless"),
        ("simulator", "direct", ["-m", "simulator", "window"], "pip install panda3d"),
        ("behavioral-cloning browse", "flask", [*INSTALLED, "browse"], "pip install flask"),
    ],
)
def test_a_missing_library_is_told_in_one_sentence(tmp_path, program, library, command, remedy):
    """As where the environment was forgotten."""
    missing = f"raise ModuleNotFoundError({library!r}, name={library!r})"
    (tmp_path / f"{library}.py").write_text(missing, encoding="utf-8")
    done = run(*command, modules=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (FAILED, 1), done.stderr
    activate = "" if program.startswith("behavioral-cloning") else "activate the environment"  # which is a clone's
    assert f"{library} is missing: {activate}" in done.stderr and in_commands(remedy) in done.stderr
    assert done.stderr.startswith(f"{program.split()[0]}")


def test_a_missing_library_is_installed_where_the_command_finds_it(tmp_path, monkeypatch):
    """The environments that uv and pipx make have no pip: that of the terminal would install it elsewhere."""
    folder = tmp_path / "behavioral-cloning"
    monkeypatch.setattr(sys, "prefix", str(folder))
    assert in_commands("`pip install flask`") == "`pip install flask`"
    folder.mkdir()
    (folder / "pyvenv.cfg").write_text("home = /usr/bin\nuv = 0.13.9\nversion_info = 3.11.7\n", encoding="utf-8")
    told = in_commands("`pip install flask`")
    assert told == in_commands(told) == f'`uv pip install --python "{folder}" flask`'
    (folder / "pipx_metadata.json").touch()
    assert in_commands("`pip install flask`") == "`pipx inject behavioral-cloning flask`"


@pytest.mark.parametrize(
    ("program", "command"),
    [
        ("model.py", ["model.py", ""]),
        ("simulator", ["-m", "simulator", "record", ""]),
        ("behavioral-cloning report", [*INSTALLED, "report", "run", ""]),
    ],
)
def test_an_empty_argument_is_not_the_current_folder(program, command):
    """As from a shell's variable that is not set."""
    done = python(*command)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (FAILED, "", 1), done.stderr
    assert done.stderr.startswith(f"{program}: an argument is empty")


def test_words_are_typed_as_the_machines_shell_reads_them(monkeypatch):
    words = "python", "video.py", r"runs\a b"
    assert as_typed(*words) == r"python video.py 'runs\a b'"
    monkeypatch.setattr(sys, "platform", "win32")
    assert as_typed(*words) == r'python video.py "runs\a b"'


@pytest.mark.parametrize("code_page", ["cp850", "ascii"])
def test_the_usage_is_shown_whatever_the_console_can_show(monkeypatch, code_page):
    monkeypatch.setenv("PYTHONIOENCODING", code_page)
    done = run(*INSTALLED, "--help")
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("usage: behavioral-cloning COMMAND ...")


def test_a_notebooks_way_to_show_figures_is_none_of_a_commands(monkeypatch):
    """Jupyter and Colab set it for `!python model.py`, too, whose environment has not their library."""
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    done = run("-c", "from cloning.base import program; program.end_on_interrupt('test'); import matplotlib")
    assert done.returncode == 0, done.stderr


def test_where_somebody_types_python_it_goes_on():
    """In a notebook the whole kernel would end with `%run model.py`."""
    ends = "from cloning.base import program; program.end_on_interrupt('test'); program.run(lambda: 3)"
    typed = "import signal; signal.raise_signal(signal.SIGINT)\nprint('alive')\n"
    command = [sys.executable, "-i", "-c", ends]
    done = subprocess.run(command, input=typed, capture_output=True, text=True, cwd=ROOT)
    assert "SystemExit: 3" in done.stderr and "KeyboardInterrupt" in done.stderr and done.stdout == "alive\n"


@pytest.mark.parametrize(("limit", "threads"), [("150000 100000", 2), ("max 100000", 8), ("90000 100000", 1), ("", 8)])
def test_a_containers_share_of_the_cores_is_all_that_is_used(tmp_path, monkeypatch, limit, threads):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    monkeypatch.setattr(cores, "LIMIT", tmp_path / "cpu.max")
    assert cores.threads() == 8, "no container"
    cores.LIMIT.write_text(f"{limit}\n", encoding="ascii")
    assert cores.threads() == threads


def test_an_old_python_is_told_in_one_sentence():
    version = "import sys; sys.version_info, sys.hexversion = (3, 10, 4), 0x30A04F0"
    done = run("-c", f"{version}; import runpy; runpy.run_path('model.py', run_name='__main__')")
    assert done.returncode == FAILED and done.stderr.count("\n") == 1
    assert "Python 3.11 or later is needed, and" in done.stderr and "is Python 3.10.4" in done.stderr


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_changed_clock_changes_no_time_in_the_progress(monkeypatch, hours):
    now = time.time
    with progress.progress_bar(4, "image") as bar:
        bar.update()
        monkeypatch.setattr("tqdm.std.time", lambda: now() + 3600 * hours)
        monkeypatch.setattr(time, "time", lambda: now() + 3600 * hours)
        bar.update()
        assert bar.format_dict["elapsed"] < 60
    with progress.progress_bar(4, "image") as bar:
        bar.update()
        monkeypatch.undo()
        bar.update()
        assert 0 <= bar.format_dict["elapsed"] < 60


def test_without_a_terminal_progress_is_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.05)
    begin = time.monotonic()
    with progress.progress_bar(100, "image", desc="training") as bar:
        for n in range(100):
            bar.update()
            bar.set_postfix_str(f"loss {n}", refresh=False)
            time.sleep(0.003)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= (time.monotonic() - begin) / 0.05, "not every update"
    assert re.fullmatch(r"training +\d+ %, \d+/100 images, 00:0\d since the start, 00:\d\d left, loss \d+", lines[0])


def test_progress_beyond_the_total_is_complete(monkeypatch, capsys):
    """As an epoch's is, which ends with a whole batch."""
    monkeypatch.setattr(progress, "LINE_SECONDS", 0.0)
    with progress.progress_bar(20, "image") as bar:
        bar.update(16)
        bar.update(16)
    assert "100 %, 32/32 images" in capsys.readouterr().err.splitlines()[-1]


def test_a_process_with_progress_that_ends_at_once_leaks_nothing():
    """Where processes are not forked, Python tells of each lock for processes that is left (macOS, Python 3.14)."""
    begin = "import multiprocessing, os; multiprocessing.set_start_method('spawn'); from cloning.base import progress"
    done = run("-c", f"{begin}; progress.progress_bar(3, 'row').update(); progress.Bar.write('done'); os._exit(0)")
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


ENDING_MAIN = """
import atexit, os, signal, sys, threading, time
from cloning.base import program
program.end_on_interrupt("test", "stopped")
def main():
    atexit.register(print, "at exit")
    if "thread" in sys.argv:
        threading.Thread(target=lambda: [time.sleep(0.3), print("thread done")]).start()
    print("main done")
    if "interrupted" in sys.argv:
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            print("cleaned up")
            raise RuntimeError("as some libraries do") from None
    return 1
program.run(main)
"""


@pytest.mark.parametrize(
    ("arguments", "later", "status", "errors"),
    [
        ([], ["at exit"], 1, ""),
        (["thread"], ["thread done", "at exit"], 1, ""),
        (["interrupted"], ["cleaned up"], 130, "test: stopped\n"),
    ],
    ids=["alone", "beside a thread", "by Ctrl-C"],
)
def test_a_command_ends_when_all_is_done_and_printed(arguments, later, status, errors):
    done = run("-c", ENDING_MAIN, *arguments)
    assert (done.returncode, done.stdout.splitlines(), done.stderr) == (status, ["main done", *later], errors)


def test_a_command_whose_stdout_is_closed_ends_as_usual():
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-c", ENDING_MAIN]
    done = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (1, b"")


FAILING_MAIN = """
import os, threading, numpy, torch
from cloning.base import program
program.end_on_interrupt("test")
program.run(lambda: {})
"""


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("numpy.empty(1 << 50)", "too little memory is free: Unable to allocate"),
        ("torch.empty(1 << 50)", "too little memory is free: "),
        (
            "[threading.stack_size(1 << 46), threading.Thread().start()]",
            "too little memory is free: can't start new thread",
        ),
        ("print(1, flush=True)", "[Errno 28] No space left on device\n"),
    ],
)
def test_too_little_space_is_a_line_and_status_2(call, message):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", FAILING_MAIN.format(call)]
        done = warm.run(command, cwd=ROOT, env={**os.environ, **HERE}, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == FAILED and done.stderr.startswith(f"test: {message}"), done.stderr
    assert "Traceback" not in done.stderr


def test_a_command_whose_last_lines_cannot_be_printed_says_so():
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    try:
        command = [sys.executable, "-c", ENDING_MAIN]
        done = subprocess.run(command, cwd=ROOT, env=environment, stdout=writer, stderr=subprocess.PIPE)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (FAILED, b"stdout: Broken pipe\n")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signal masks")
def test_ctrl_c_stays_deferred_when_the_first_process_starts():
    """multiprocessing starts a helper then, and unblocks signals, and Ctrl-C ended the one that starts the others."""
    code = (
        "import multiprocessing, signal; from cloning.base.processes import starting\n"
        "with starting():\n"
        "    multiprocessing.get_context('forkserver').Process(target=print).start()\n"
        "    assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])"
    )
    assert run("-c", code).returncode == 0
