"""Properties of the simulator's client that both ends of the wire rely on."""

from dataclasses import dataclass

PORT = 4567  # on which the simulator expects the server
FRAGMENT = 1016  # bytes: the client splits longer messages
PING_INTERVAL, PONG_TIMEOUT = 25, 60  # s: the client pings this often, and gives up without an answer in this time
MAX_NAME = 40  # characters of a road's name
# The field that the stand-in simulator adds to each telemetry: a `Place`, or in replays and benchmarks its time alone
STAND_IN = "stand_in"


@dataclass(frozen=True)
class Place:
    """Where the stand-in simulator's car is, and how it got there."""

    track: str  # name of the road, of at most MAX_NAME characters; of a --road, one that no known road has
    x: float  # m to the east
    y: float  # m to the north
    offset: float  # m to the right of the road's centre line
    departures: int  # how often it has left the road
    time: float  # simulated seconds


def where_options(host: str, port: int | str) -> str:
    """Return the options with which a command listens or connects there, each after a space; none at the usual one."""
    return f" --host {host}" * (host not in ("127.0.0.1", "localhost")) + f" --port {port}" * (str(port) != str(PORT))
