"""The socket libraries, for the modules of the server's end; commands call `check_versions` before they import those.

With some other versions, the imports below fail.
"""

import warnings

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
