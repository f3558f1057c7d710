"""The usual shape of a server for the simulator, as the yardstick: Pillow, a broadcast, the libraries as they are."""

import base64
import io
import logging
import sys
import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import eventlet
    import eventlet.wsgi
import flask
import numpy as np
import socketio
import torch
from PIL import Image

from cloning.pilot.network import load_model

logging.disable()
torch.set_num_threads(1)  # as in drive.py, so that the wire makes the difference
network = load_model(sys.argv[1])
server = socketio.Server()


@server.on("connect")
def connect(sid, environ):
    send(0, 0)


@server.on("telemetry")
def telemetry(sid, data):
    image = Image.open(io.BytesIO(base64.b64decode(data["image"])))
    with torch.no_grad():
        steering = float(network(torch.from_numpy(np.array(image)[None]))[0])
    send(steering, 0.1 * (9 - float(data["speed"])))


def send(steering, throttle):
    server.emit("steer", {"steering_angle": str(steering), "throttle": str(throttle)}, skip_sid=True)


if __name__ == "__main__":
    listener = eventlet.listen(("127.0.0.1", 0))
    print(f"Listening on 127.0.0.1:{listener.getsockname()[1]}.\nWatch at nothing.", file=sys.stderr, flush=True)
    eventlet.wsgi.server(listener, socketio.WSGIApp(server, flask.Flask(__name__)), log_output=False)
