"""The server's end of the wire: drive.py and its page are served to the simulator and to browsers."""
