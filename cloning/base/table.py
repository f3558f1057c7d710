"""Tables in columns: what is known of n rows, in one array for each property."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Self

import numpy as np

Column = Annotated[np.ndarray, "one entry for each row"]


@dataclass(frozen=True)
class Table:
    """The base of all tables: a dataclass whose fields of type Column, or of a type of table, have n rows each.

    Its other fields are about the table as a whole. A table is never changed.
    """

    @classmethod
    def columns(cls) -> list[str]:
        """Return the names of the fields that have a row each, in their order."""
        tables = (item.name for item in fields(cls) if isinstance(item.type, type) and issubclass(item.type, Table))
        return [*(item.name for item in fields(cls) if item.type == Column), *tables]

    def __len__(self) -> int:
        return len(getattr(self, self.columns()[0]))

    def take(self, rows: np.ndarray | slice, **changed: Any) -> Self:
        """Return these rows, in this order; rows: indices, or a mask, bool (n,); changed: other fields' new values."""
        taken = {}
        for name in self.columns():
            column = getattr(self, name)
            taken[name] = column.take(rows) if isinstance(column, Table) else column[rows]
        return replace(self, **{**taken, **changed})

    @classmethod
    def joined(cls, parts: Sequence[Self], **changed: Any) -> Self:
        """Return the rows of all parts, one after the other; all else is the first part's, or in `changed`."""
        columns: dict[str, Any] = {}
        for name in cls.columns():
            found = [getattr(part, name) for part in parts]
            columns[name] = type(found[0]).joined(found) if isinstance(found[0], Table) else np.concatenate(found)
        return replace(parts[0], **{**columns, **changed})
