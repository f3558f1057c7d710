"""Import the socket libraries, for the other modules of the server's end, once their versions are checked."""

import warnings

from cloning.server.versions import check_versions

check_versions()  # before the imports below, which fail with some versions

with warnings.catch_warnings():
    # eventlet advises against using it in new projects, but no server has been used longer with this simulator.
    warnings.simplefilter("ignore")
    import engineio
    import engineio.async_drivers.eventlet
    import engineio.socket
    import eventlet
    import eventlet.tpool
    import eventlet.websocket
    import eventlet.wsgi
    import socketio

__all__ = ["engineio", "eventlet", "socketio"]
