"""Fills an empty R*Tree of SQLite in one pass: points are sorted into full nodes instead of inserted one by one.

SQLite keeps an R*Tree in three ordinary tables (https://www.sqlite.org/rtree.html, "Shadow Tables"). A node is a blob:
its depth (of the root, else zero) and its number of cells as two big-endian 16-bit numbers, then cells of a 64-bit id
(of a row, or of the node below) and the box as 32-bit floats: minimum and maximum of each axis, rounded outward.
Packing: Leutenegger, Lopez, Edgington, "STR: a simple and efficient algorithm for R-tree packing", ICDE 1997.
What it gains is in docs/decisions/0002-registry-store.md.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

_CELL = np.dtype([("id", ">i8"), ("box", ">f4", (4,))])
_HEADER = np.dtype([("depth", ">u2"), ("cells", ">u2")])
_ROOT = 1
_PART = 20_000  # rows read or written at a time; chosen by hand

Ids = npt.NDArray[np.int64]
Boxes = npt.NDArray[np.float32]


def fill_rtree(connection: sa.Connection, table: str) -> None:
    """Fill the empty R*Tree of a table with the positions of all its rows."""
    rtree = f"{table}_rtree"
    ids, boxes = _read_boxes(connection, table)
    if not len(ids):
        return
    size = connection.exec_driver_sql(f"SELECT length(data) FROM {rtree}_node WHERE nodeno = 1").scalar_one()
    depth, next_node = 0, _ROOT + 1
    max_cells = (int(size) - _HEADER.itemsize) // _CELL.itemsize
    while len(ids) > max_cells:
        order, starts = _packed(boxes, max_cells)
        ids, boxes = ids[order], boxes[order]
        nodes = np.arange(next_node, next_node + len(starts), dtype=np.int64)
        _store(connection, rtree, ids, boxes, nodes, starts, size=size, is_leaf=depth == 0)
        low, high = (f.reduceat(boxes, starts) for f in (np.minimum, np.maximum))
        boxes = np.stack([low[:, 0], high[:, 1], low[:, 2], high[:, 3]], axis=1)
        ids, depth, next_node = nodes, depth + 1, next_node + len(nodes)
    root = np.array([_ROOT], dtype=np.int64)
    _store(connection, rtree, ids, boxes, root, np.zeros(1, dtype=np.intp), size=size, is_leaf=depth == 0, depth=depth)


def _read_boxes(connection: sa.Connection, table: str) -> tuple[Ids, Boxes]:
    """Rows, shape (N,), and the boxes of their positions, shape (N, 4)."""
    driver = connection.connection.driver_connection
    assert driver is not None
    cursor = driver.execute(f"SELECT row, lon_deg, lat_deg FROM {table}")
    ids, boxes = [np.empty(0, dtype=np.int64)], [np.empty((0, 4), dtype=np.float32)]
    while rows := cursor.fetchmany(_PART):
        part = np.array(rows, dtype=np.float64)
        ids.append(part[:, 0].astype(np.int64))
        boxes.append(_outward(part[:, 1:]))
    return np.concatenate(ids), np.concatenate(boxes)


def _outward(positions: npt.NDArray[np.float64]) -> Boxes:
    """Boxes of points, shape (N, 4): each side the next 32-bit float that is not inside."""
    near = positions.astype(np.float32)
    low = np.where(near > positions, np.nextafter(near, np.float32(-np.inf)), near)
    high = np.where(near < positions, np.nextafter(near, np.float32(np.inf)), near)
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1).astype(np.float32)


def _packed(boxes: Boxes, max_cells: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Order of the entries and the first of each node: slices of longitude, in each runs of latitude."""
    nodes = math.ceil(len(boxes) / max_cells)
    slices = math.ceil(math.sqrt(nodes))
    by_lon = np.argsort(boxes[:, 0], kind="stable")
    number = np.empty(len(boxes), dtype=np.int32)
    number[by_lon] = np.arange(len(boxes)) * slices // len(boxes)
    order = np.lexsort((boxes[:, 2], number))
    starts = []
    for first, last in zip(*_edges(number[order]), strict=True):
        parts = math.ceil((last - first) / max_cells)
        starts.append(first + np.arange(parts) * (last - first) // parts)
    return order, np.concatenate(starts)


def _edges(number: npt.NDArray[np.int32]) -> tuple[list[int], list[int]]:
    changes = (np.flatnonzero(np.diff(number)) + 1).tolist()
    return [0, *changes], [*changes, len(number)]


def _store(
    connection: sa.Connection,
    rtree: str,
    ids: Ids,
    boxes: Boxes,
    nodes: Ids,
    starts: npt.NDArray[np.intp],
    *,
    size: int,
    is_leaf: bool,
    depth: int = 0,
) -> None:
    """Write nodes, and which node each of their entries is in."""
    counts = np.diff([*starts, len(ids)])
    cells = np.empty(len(ids), dtype=_CELL)
    cells["id"], cells["box"] = ids, boxes
    blobs = (
        _node(cells[start : start + count], depth, size) for start, count in zip(starts.tolist(), counts, strict=True)
    )
    driver = connection.connection.driver_connection
    assert driver is not None
    driver.executemany(f"INSERT OR REPLACE INTO {rtree}_node VALUES (?, ?)", zip(nodes.tolist(), blobs, strict=True))
    del cells, blobs
    child = f"{rtree}_rowid" if is_leaf else f"{rtree}_parent"
    order = np.argsort(ids, kind="stable")
    parents = np.repeat(nodes, counts)[order]
    for start in range(0, len(order), _PART):
        part = slice(start, start + _PART)
        within = zip(ids[order[part]].tolist(), parents[part].tolist(), strict=True)
        driver.executemany(f"INSERT INTO {child} VALUES (?, ?)", within)


def _node(cells: npt.NDArray[np.void], depth: int, size: int) -> bytes:
    header = np.array((depth, len(cells)), dtype=_HEADER)
    return (header.tobytes() + cells.tobytes()).ljust(size, b"\x00")
