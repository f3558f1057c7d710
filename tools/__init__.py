"""Tools: benchmarks and the training of the networks; run one with `python -m tools.NAME`."""

import signal
import sys

from cloning.base import program

if sys.argv[0] == "-m":  # as long as Python looks for the tool: Ctrl-C needs no traceback while its libraries load, too
    tool = next((word for word in sys.orig_argv if word.startswith(("tools.", "-mtools."))), "tools")
    name = tool.removeprefix("-m").removeprefix("tools.")
    program.end_on_interrupt(name, "stopped" + "; start it again to continue" * (name == "demo"))
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # it ends what it has started, too
