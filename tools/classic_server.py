"""A typical server for the simulator, the baseline of the benchmark: Pillow, broadcast answers, default settings."""

import base64
import io
import logging
import sys
import warnings
from typing import Any

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # eventlet advises against its use in new projects
    import engineio.packet
    import engineio.socket
    import eventlet
    import eventlet.wsgi
import flask
import numpy as np
import socketio
import torch
from PIL import Image

from cloning.network.network import Network, load_model

SET_SPEED, PROPORTIONAL = 9.0, 0.1  # mph, throttle per mph


class Socket(engineio.socket.Socket):
    """A session with a client that sends pings, as the simulator does."""

    def receive(self, packet: Any) -> None:
        """Handle a packet."""
        if packet.packet_type == engineio.packet.PING:
            self.send(engineio.packet.Packet(engineio.packet.PONG))
        else:
            super().receive(packet)


class Server(socketio.Server):
    """A server that connects a client which does not ask for it, as the simulator doesn't."""

    def _handle_eio_connect(self, eio_sid: str, environ: dict[str, Any]) -> None:
        super()._handle_eio_connect(eio_sid, environ)
        self._handle_connect(eio_sid, "/", None)


def create_server(network: Network) -> socketio.Server:
    """Return a server that answers each telemetry with the network's steering, to all clients."""
    engineio.socket.Socket = Socket
    server = Server()

    def send(steering: float, throttle: float) -> None:
        server.emit("steer", {"steering_angle": str(steering), "throttle": str(throttle)})

    def connect(sid: str, environ: dict[str, Any], auth: object) -> None:
        send(0, 0)

    def telemetry(sid: str, data: dict[str, str]) -> None:
        image = Image.open(io.BytesIO(base64.b64decode(data["image"])))
        with torch.no_grad():
            steering = float(network(torch.from_numpy(np.array(image)[None]))[0])
        send(steering, PROPORTIONAL * (SET_SPEED - float(data["speed"])))

    server.on("connect", connect)
    server.on("telemetry", telemetry)
    return server


def main() -> None:
    """Drive with the model file named on the command line, on a free port."""
    logging.disable()
    torch.set_num_threads(1)  # as in drive.py, so that the network takes the same time
    server = create_server(load_model(sys.argv[1]))
    listener = eventlet.listen(("127.0.0.1", 0))
    print(f"Listening on 127.0.0.1:{listener.getsockname()[1]}.", file=sys.stderr, flush=True)
    eventlet.wsgi.server(listener, socketio.WSGIApp(server, flask.Flask(__name__)), log_output=False)
