"""What the user can mend: each error's message names the file (and line) and the remedy; commands print it and end."""


class UserError(Exception):
    """Something that the user can mend; the message says what and how."""


class RecordingError(UserError):
    """A recording that cannot be read or written; the message names the file and, where there is one, the line."""


class ModelError(UserError):
    """A model file that cannot be used or resumed."""


class FolderError(UserError):
    """A folder that frames cannot be saved in."""


class SimulatorError(UserError):
    """The stand-in simulator, its window or its server cannot go on."""


class OutputError(UserError):
    """A file that the user asked for and that cannot be written."""
