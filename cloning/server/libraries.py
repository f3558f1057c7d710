"""The socket libraries, for the modules of the server's end; commands import those in `main`, to tell of errors."""

import importlib.metadata
import os
import warnings

from cloning.base.errors import UserError

try:
    installed = importlib.metadata.version("python-socketio")
    if installed.split(".")[0] != "5":
        raise ImportError(f"python-socketio is {installed} and must be 5")
    with warnings.catch_warnings():
        # eventlet advises against using it in new projects, but no server has been used longer with this simulator.
        warnings.simplefilter("ignore")
        os.environ.setdefault("EVENTLET_NO_GREENDNS", "yes")  # a server looks up no name; else 0.1 s more to load
        import engineio
        import engineio.packet
        import engineio.socket
        import eventlet
        import eventlet.tpool
        import eventlet.websocket
        import eventlet.wsgi
        import socketio
except ImportError as error:  # PackageNotFoundError is one, too
    raise UserError(f"{error}: run `pip install .` in the folder of the project") from error

__all__ = ["engineio", "eventlet", "socketio"]
