"""Files of strangers: what a decoder is given, how much memory it may take, and what a sentence quotes of them."""

import io
import json
import resource
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.picture import check_jpeg
from rover_lib.onboard.errors import CameraError, EpisodeError
from rover_lib.onboard.stage import read_plain

JSON_BYTES = 60_000_000  # an hour and a half of driving
LONGEST = 60  # characters of one value
QUOTED = 6  # values
LARGEST = 10**20  # Python refuses to print an integer of thousands of digits
MEMORY_BYTES = 450_000_000  # a frame of 4608x2592 takes 36 MB; a decoder holds a few
STATM = Path("/proc/self/statm")
FORMATS = ("PNG", "JPEG")  # what LeRobot writes; Pillow would start Ghostscript for PostScript
CODECS = ("h264", "hevc", "av1", "libdav1d")  # what LeRobot writes, by FFmpeg's names of decoders
ZEROS = bytes(32)  # in a row; the codecs put another byte after two, or hardly ever write as many
MOST_DECODED = 300_000_000  # pixels of a video that are decoded to find damage: 1,300 pictures of 640x360, seconds
AHEAD = 8  # pictures that a decoder may read before it gives one; an error there costs that one too
ROW_BYTES = 4  # in a table, a frame's index and its time alone take more
_LOCK = threading.RLock()


@contextmanager
def limited_memory(more_bytes: int = 0) -> Iterator[None]:
    """Inside the block this process may take MEMORY_BYTES + more_bytes more than it has; then allocations fail.

    One thread at a time, because the limit is the process's. On systems without /proc there is no limit.
    """
    if not STATM.exists():
        yield
        return
    with _LOCK:
        before = resource.getrlimit(resource.RLIMIT_DATA)  # of private memory, without reserved addresses
        used_bytes = int(STATM.read_text().split()[5]) * resource.getpagesize()
        ends = [end for end in (used_bytes + MEMORY_BYTES + more_bytes, *before) if end != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_DATA, (min(ends), before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, before)


def check_inside(root: Path, path: Path) -> None:
    """Raise EpisodeError for a path that leads out of a dataset's folder; the Hub's cache keeps files beside it."""
    real = path.resolve()
    home = root.resolve()
    in_hub = home.parent.name == "snapshots" and path.is_file() and real.is_relative_to(home.parents[1] / "blobs")
    if not real.is_relative_to(home) and not in_hub:
        raise EpisodeError(f"{path}: leads out of the dataset", found=quote(str(real)), remedy="copy the files into it")


def check_encoded(data: bytes, size: tuple[int, int]) -> str:
    """Return what is wrong with a table's picture that must be a whole PNG or JPEG in colours, of (height, width)."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as picture:
            size_found = (picture.height, picture.width)
            mode = picture.mode
            if picture.format == "PNG":
                picture.verify()  # its checksums; no pixel is computed
        if size_found == size and picture.format == "JPEG":
            check_jpeg(data)
    except CameraError as e:
        return str(e)
    except (OSError, TypeError, ValueError, SyntaxError, Image.DecompressionBombError):
        return "missing or damaged, or neither PNG nor JPEG"
    if size_found != size:
        return f"of another shape than {size} in meta/info.json, found {size_found}"
    return "" if mode == "RGB" else f"not in colours (RGB), found {quote(mode)}"


def check_video(path: Path, size: tuple[int, int]) -> None:
    """Raise EpisodeError unless a file is an MP4 of one of CODECS and of (height, width); nothing is decoded."""
    import av

    with path.open("rb") as file:
        begins = file.read(8)
    if begins[4:] != b"ftyp":  # FFmpeg would take a playlist, and read what that names
        raise EpisodeError(f"{path}: cannot be decoded: not an MP4", found=quote(begins), remedy="record it again")
    with av.open(str(path), format="mp4") as container:
        stream = container.streams.video[0]
        stream_form = stream.codec_context.name, stream.height, stream.width
    if stream_form[0] not in CODECS or stream_form[1:] != size:
        problem = f"{path}: has another shape or codec than {size} in h264, hevc or av1"
        raise EpisodeError(problem, found=stream_form, remedy="encode it anew")


def scan_video(path: Path) -> tuple[list[float], set[float]]:
    """Return when the pictures of a video are shown, in seconds, in order; and when those that are torn are.

    A picture needs those before it, up to one that is whole by itself, and LeRobot 0.6 looks for that one from a tick
    before the picture, so that the first after a torn one is lost too. All packets are read: an encoder writes no row
    of zeros, as a copy does that was not finished. Some are decoded, as other damage shows there only.
    """
    import av

    with av.open(str(path), format="mp4") as container:
        stream = container.streams.video[0]
        packets: list[Any] = [packet for packet in container.demux(stream) if packet.pts is not None]
        begins = [k for k, packet in enumerate(packets) if packet.is_keyframe or k == 0]
        groups = [packets[a:b] for a, b in pairwise([*begins, len(packets)])]
        stride = max(1, round(len(packets) * stream.height * stream.width / MOST_DECODED))
        torn: set[int] = set()
        for number, (group, first) in enumerate(zip(groups, begins, strict=True)):
            bad = next((k for k, packet in enumerate(group) if ZEROS in bytes(packet)), len(group))
            if bad == len(group) and number % stride == 0:
                bad = _decoded(stream.codec_context, group)
            if bad < len(group):
                torn |= {*range(max(0, first + bad - AHEAD), first + len(group) + 1)}
        times_s = [float(packet.pts * packet.time_base) for packet in packets]
    return sorted(times_s), {time_s for k, time_s in enumerate(times_s) if k in torn}


def _decoded(decoder: Any, packets: list[Any]) -> int:
    """Return how many of a group of pictures can be decoded before the first that cannot."""
    import av

    times = set()
    decoder.flush_buffers()
    for packet in (*packets, None):  # decoders keep some pictures back until the end
        with suppress(av.FFmpegError):
            times |= {frame.pts for frame in decoder.decode(packet) if not frame.is_corrupt}
    return next((k for k, packet in enumerate(packets) if packet.pts not in times), len(packets))


def check_table(path: Path) -> list[str]:
    """Return the names of a parquet table's columns. Raises EpisodeError for more rows than its bytes can hold."""
    from pyarrow import parquet

    table = parquet.read_metadata(path)
    if (size := path.stat().st_size) < ROW_BYTES * table.num_rows:
        problem = f"{path}: its footer says {table.num_rows} rows"
        raise EpisodeError(problem, found=f"{size} bytes", remedy="copy the dataset again")
    return table.schema.to_arrow_schema().names


def read_json(path: Path, most_bytes: int = JSON_BYTES) -> Any:
    """Return what a JSON file holds, which may take 25 times its size: see `limited_memory`.

    Raises OSError if it cannot be read or is larger, and ValueError for what is no JSON.
    """
    try:
        return json.loads(read_plain(path, most_bytes))
    except RecursionError:  # brackets nested too deep
        raise ValueError("nested too deep") from None


def quote(value: object) -> str:
    """A value for a sentence.

    Of what holds other values only the type and length: the whole could be endless, or hold itself.
    """
    if isinstance(value, bool | float | None):
        return repr(value)
    if isinstance(value, int):
        return repr(value) if abs(value) < LARGEST else f"an integer of {value.bit_length()} bits"
    if isinstance(value, str | bytes):
        text = repr(value[:LONGEST])
        return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
    length = f" of {len(value)}" if isinstance(value, dict | list | tuple | set) else ""
    return f"a {type(value).__name__}{length}"


def quote_all(values: Iterable[object]) -> str:
    """The first values, separated by commas, names without quotes, and how many more there are."""
    values = list(values)
    names = [v if isinstance(v, str) and v.isprintable() and len(v) <= LONGEST else quote(v) for v in values[:QUOTED]]
    return ", ".join(names) + (f" and {len(values) - QUOTED} more" if len(values) > QUOTED else "")
