"""Definitions and messages of ROS that are drawn at random, and bags of them."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout
from sparseskin.plugins.bridges import cdr

NUMBERS = (
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
    *("float32", "float64", "bool"),
)
SEPARATOR = "=" * 80
BEGIN_NS = 1_790_000_000_000_000_000
PERIOD_NS = 20_000_000
TOPIC = "/tactile"
STREAM = "maker_msgs/msg/Stream"
STREAM_TEXT = f"""std_msgs/Header header  # of the first taxel
uint8 KIND=3
string name
maker_msgs/Module[] modules
{SEPARATOR}
MSG: maker_msgs/Module
uint8 place
Taxel[] taxels
{SEPARATOR}
MSG: maker_msgs/Taxel
uint8 id
int32 x
int32 y
int32 z
"""
"""As makers of skins define them: a list of modules, each with a list of taxels of three axes."""


def store_of(ros: int) -> Any:
    """Types of ROS, to which others can be added."""
    return get_typestore(Stores.ROS2_JAZZY if ros == 2 else Stores.ROS1_NOETIC)


def stream_store(ros: int) -> Any:
    return registered(store_of(ros), STREAM, STREAM_TEXT)


def registered(store: Any, kind: str, text: str) -> Any:
    """The store with a type and those of its members, as a bag writes their definitions."""
    head, *rest = text.split(SEPARATOR + "\n")
    types = get_types_from_msg(head, kind)
    for part in rest:
        name, _, body = part.partition("\n")
        types |= get_types_from_msg(
            body, name.removeprefix("MSG: ").replace("/", "/msg/")
        )
    store.register(types)
    return store


@st.composite
def definitions(draw: st.DrawFn) -> tuple[str, str]:
    """The name of a type, and its definition with those of its members."""
    n_types = draw(st.integers(1, 4))
    texts = []
    for number in range(n_types):
        inner = [f"any_msgs/T{k}" for k in range(number)]
        lines = []
        for k in range(draw(st.integers(1, 4))):
            kind = draw(st.sampled_from((*NUMBERS, *NUMBERS, "string", *inner, *inner)))
            ending = draw(st.sampled_from(("", "", "[]", "[2]", "[<=3]")))
            lines.append(f"{kind}{ending} m{k}")
            if draw(st.booleans()):
                lines.append(f"# a comment\nint32 LIMIT_{k}=5 # of it")
        texts.append("\n".join(lines) + "\n")
    parts = [
        texts[-1],
        *(f"MSG: any_msgs/T{k}\n{texts[k]}" for k in range(n_types - 1)),
    ]
    return f"any_msgs/msg/T{n_types - 1}", f"{SEPARATOR}\n".join(parts)


def value_of(draw: st.DrawFn, store: Any, form: Any) -> Any:
    """A value of a form of rosbags."""
    node, of = form
    if node == Nodetype.NAME:
        members = [
            value_of(draw, store, member) for _, member in store.fielddefs[of][1]
        ]
        return store.types[of](*members)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        inner, size = of
        n = size if node == Nodetype.ARRAY else draw(st.integers(0, 3))
        values = [value_of(draw, store, inner) for _ in range(n)]
        is_number = inner[0] == Nodetype.BASE and inner[1][0] in NUMBERS
        return np.array(values, inner[1][0]) if is_number else values
    kind = of[0]
    if kind == "string":
        return draw(
            st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=5)
        )
    if kind == "bool":
        return draw(st.booleans())
    if kind.startswith("float"):
        return draw(st.floats(width=int(kind[-2:]), allow_nan=False))
    limits = np.iinfo(kind)
    return draw(st.integers(int(limits.min), int(limits.max)))


def same(decoded: Any, value: Any) -> bool:
    """True if a decoded value is the one that was written."""
    if isinstance(value, np.ndarray):
        return np.array_equal(decoded, value) and decoded.dtype.kind == value.dtype.kind
    if isinstance(value, list):
        pairs = zip(decoded, value, strict=True)
        return all(same(one, other) for one, other in pairs)
    if hasattr(value, "__msgtype__"):
        names = decoded.dtype.names if hasattr(decoded, "dtype") else tuple(decoded)
        return all(same(decoded[name], getattr(value, name)) for name in names)
    return bool(decoded == value)


@dataclass(frozen=True)
class Grid:
    """How the readings of a bag are laid out in its messages."""

    kind: str  # "image", "cloud", "array", "stream"
    n_rows: int
    n_cols: int
    dtype: str
    axes: int = 1  # numbers per taxel
    labels: tuple[str, ...] = ()
    padding: int = 0  # between rows

    @property
    def layout(self) -> Layout:
        """What is stated of it: as little as is needed."""
        if self.kind == "stream" or (self.kind == "array" and not self.labels):
            return replace(EMPTY, n_rows=self.n_rows, n_cols=self.n_cols)
        return EMPTY


@dataclass(frozen=True)
class Sent:
    """A message of a bag: its frame, None where it has no number, its frame_id and its times."""

    frame: Any
    frame_id: str
    stamp_ns: int
    log_ns: int


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    kind = draw(st.sampled_from(("image", "cloud", "array", "stream")))
    n_rows, n_cols = draw(st.integers(2, 5)), draw(st.integers(2, 5))
    dtypes = {
        "image": ("u1", "<u2", ">f4"),
        "cloud": ("<f4", ">u2"),
        "stream": ("<i4",),
    }
    dtype = draw(st.sampled_from(dtypes.get(kind, ("<f4", "<i2", "<u4"))))
    axes = draw(st.sampled_from((1, 3))) if kind in ("image", "array") else 3
    if kind == "cloud":
        axes = 1
    labels = draw(
        st.sampled_from((("rows", "cols"), ("height", "width"), ("cols", "rows"), ()))
    )
    if kind != "array":
        labels = ()
    if not labels and kind == "array":
        axes = 1
    padding = draw(st.integers(0, 3))
    return Grid(kind, n_rows, n_cols, dtype, axes, labels, padding)


def frames_sent(draw: st.DrawFn, grid: Grid, n_most: int = 7) -> list[Sent]:
    """Messages, some of them without a number, and the times of some repeated."""
    sent: list[Sent] = []
    # An image of no pixel has no size either.
    is_empty = st.sampled_from((False, False, False, True))
    now_ns = BEGIN_NS
    for k in range(draw(st.integers(1, n_most))):
        now_ns += draw(st.sampled_from((PERIOD_NS, PERIOD_NS, 3 * PERIOD_NS)))
        frame = (
            np.arange(grid.n_rows * grid.n_cols).reshape(grid.n_rows, grid.n_cols) + k
        )
        is_none = draw(is_empty)
        sent.append(
            Sent(None if is_none else frame, "palm", now_ns - 1_000_000, now_ns)
        )
    return sent


def message_of(store: Any, ros: int, grid: Grid, sent: Sent) -> tuple[str, Any]:
    """The type and the message of a frame."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"](*divmod(sent.stamp_ns, 10**9))
    numbered = {"seq": 1} if ros == 1 else {}
    header = types["std_msgs/msg/Header"](
        **numbered, stamp=time, frame_id=sent.frame_id
    )
    frame = np.zeros((0, 0)) if sent.frame is None else sent.frame
    of_axes = np.stack([-frame, 2 * frame, frame], axis=-1) if grid.axes == 3 else frame
    writers = {"image": _image, "cloud": _cloud, "array": _array, "stream": _stream}
    return writers[grid.kind](types, header, grid, of_axes)


def _image(types: Any, header: Any, grid: Grid, values: Any) -> tuple[str, Any]:
    dtype = np.dtype(grid.dtype)
    code = f"{8 * dtype.itemsize}{ {'u': 'U', 'i': 'S', 'f': 'F'}[dtype.kind] }C{grid.axes}"
    n_rows, n_cols = values.shape[:2]
    n_bytes = n_cols * grid.axes * dtype.itemsize
    rows = np.frombuffer(values.astype(dtype).tobytes(), "u1").reshape(n_rows, n_bytes)
    rows = np.pad(rows, ((0, 0), (0, grid.padding)), constant_values=7)
    is_big = int(grid.dtype[0] == ">")
    members = (header, n_rows, n_cols, code, is_big, rows.shape[1], rows.ravel())
    return cdr.IMAGE, types[cdr.IMAGE](*members)


def _cloud(types: Any, header: Any, grid: Grid, values: Any) -> tuple[str, Any]:
    field = types["sensor_msgs/msg/PointField"]
    number = {"<f4": 7, ">u2": 4}[grid.dtype]
    cells = np.zeros(values.shape, [("x", "<f4"), ("force", grid.dtype), ("pad", "u1")])
    cells["force"] = values
    data = cells.view("u1").ravel() if values.size else np.zeros(0, "u1")
    pitch = cells.dtype.itemsize
    n_rows, n_cols = values.shape
    places = [field("x", 0, 7, 1), field("force", 4, number, 1)]
    is_big = grid.dtype[0] == ">"
    sizes = (header, n_rows, n_cols, places, is_big, pitch, pitch * n_cols, data, True)
    return cdr.CLOUD, types[cdr.CLOUD](*sizes)


def _array(types: Any, header: Any, grid: Grid, values: Any) -> tuple[str, Any]:
    name = {"<f4": "Float32", "<i2": "Int16", "<u4": "UInt32"}[grid.dtype]
    kind = f"std_msgs/msg/{name}MultiArray"
    transposed = values.swapaxes(0, 1) if grid.labels == ("cols", "rows") else values
    sizes = transposed.shape
    labels = (*grid.labels, "xyz")[: len(sizes)]
    steps = [int(np.prod(sizes[at:])) for at in range(len(sizes))]
    flat = transposed.ravel()
    if grid.labels and len(sizes) == 2:
        # The stride of a row is longer than the row.
        flat = np.pad(
            transposed, ((0, 0), (0, grid.padding)), constant_values=99
        ).ravel()
        steps = [flat.size, sizes[1] + grid.padding]
    offset = grid.padding
    data = np.concatenate([np.full(offset, 77), flat]).astype(grid.dtype)
    made = types["std_msgs/msg/MultiArrayDimension"]
    dims = (
        [made(*one) for one in zip(labels, sizes, steps, strict=True)]
        if grid.labels
        else []
    )
    if values.size == 0:
        data = data[:0]
    layout = types["std_msgs/msg/MultiArrayLayout"](dims, offset if values.size else 0)
    return kind, types[kind](layout, data)


def _stream(types: Any, header: Any, grid: Grid, values: Any) -> tuple[str, Any]:
    taxel = types["maker_msgs/msg/Taxel"]
    taxels = (
        [taxel(1, *map(int, axes)) for axes in values.reshape(-1, 3)]
        if values.size
        else []
    )
    modules = [types["maker_msgs/msg/Module"](7, taxels)] if taxels else []
    return STREAM, types[STREAM](header, "skin", modules)


def write_bag(
    folder: Path,
    storage: str,
    mode: str,
    grid: Grid,
    sent: list[Sent],
    topic: str = TOPIC,
) -> Path:
    """Write a bag: storage "bag", "db3" or "mcap", and mode "", "chunk", "file" or "message" of
    its compression. The path of its file, or of its folder.
    """
    ros = 1 if storage == "bag" else 2
    store = stream_store(ros)
    path = folder / ("a.bag" if ros == 1 else "bag")
    shutil.rmtree(path, ignore_errors=True)
    path.unlink(missing_ok=True)
    writer: Any
    if ros == 1:
        writer = rosbag1.Writer(path)
        writer.chunk_threshold = 600
        if mode:
            forms = writer.CompressionFormat
            writer.set_compression(forms.LZ4 if mode == "file" else forms.BZ2)
    else:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if mode == "chunk":
            mode = "storage" if storage == "mcap" else ""
        if mode:
            writer.set_compression(
                CompressionMode[mode.upper()], CompressionFormat.ZSTD
            )
    encode = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with writer:
        connections: dict[str, Any] = {}
        for message in sent:
            kind, body = message_of(store, ros, grid, message)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], message.log_ns, encode(body, kind))
    return path


def files_of(path: Path) -> list[Path]:
    """The files of a bag."""
    if path.is_file():
        return [path]
    return sorted(
        file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".zstd")
    )


def interleaved(first: list[Sent], second: list[Sent], frame_id: str) -> list[Sent]:
    """Messages of two frames by turns."""
    others = [
        replace(sent, frame_id=frame_id, log_ns=sent.log_ns + 1) for sent in second
    ]
    pairs = itertools.zip_longest(first, others)
    return [sent for pair in pairs for sent in pair if sent is not None]
