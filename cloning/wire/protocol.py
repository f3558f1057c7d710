"""Properties of the simulator's client that both ends of the wire rely on."""

PORT = 4567  # on which the simulator expects the server
FRAGMENT = 1016  # bytes: the client splits longer messages
PING_INTERVAL, PONG_TIMEOUT = 25, 60  # s: the client pings this often, and gives up without an answer in this time
