"""Tables in columns."""

from dataclasses import dataclass

import numpy as np

from cloning.base.table import Column, Table


@dataclass(frozen=True)
class Points(Table):
    x: Column
    y: Column


@dataclass(frozen=True)
class Named(Table):
    name: str
    size: Column
    points: Points


def test_rows_are_taken_and_joined_in_all_columns_and_in_tables_within():
    size = np.array([3, 1, 2])
    table = Named("first", size, Points(np.array([0.0, 0.1, 0.2]), np.array([[0, 0], [1, 1], [2, 2]])))
    small = table.take(table.size < 3)
    assert (len(table), len(small), small.name) == (3, 2, "first")
    assert small.points.x.tolist() == [0.1, 0.2] and small.points.y.tolist() == [[1, 1], [2, 2]]
    joined = Named.joined([small, table.take(slice(0, 1), name="other")], name="both")
    assert (joined.name, joined.size.tolist()) == ("both", [1, 2, 3])
    assert joined.points.y.tolist() == [[1, 1], [2, 2], [0, 0]]
    assert table.size is size and size.tolist() == [3, 1, 2]
    assert table.take(np.array([2, 2]), size=np.array([7, 8])).size.tolist() == [7, 8]
