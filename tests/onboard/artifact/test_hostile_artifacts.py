"""Artifacts that somebody made to do harm: none is used, nothing harmful in them runs, and none costs much.

Each is staged as on a rover, in a process of its own, whose memory and time are judged. If staging accepts it, its
parity vectors are run there, confined, as rover-check@ does it. docs/safety.md says who would do that, and what stops
them.
"""

import io
import json
import os
import pickle
import resource
import signal
import struct
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from archives import Edit, manifest_with, rewritten, vectors_with

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact import manifest as artifact
from rover_lib.onboard.artifact.acceptance import Expected
from rover_lib.onboard.car.host import Host
from rover_lib.onboard.care.release import Releases
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.policy.confine import confine, memory_mb
from rover_lib.onboard.policy.torch_engine import (
    load as _load,  # noqa: F401, torch is imported before limits, as by verify
)

pytestmark = pytest.mark.slow  # there are 110, each with a process of its own

MOST_MB, MOST_S = 300.0, 5.0
EITHER = Expected(modes=("fp32", "static"))
HARM = "harm"  # the file that a hostile program would write into the working folder


@dataclass(frozen=True)
class Outcome:
    """What a rover did with an artifact: whether it was staged, the error's sentence, and the cost."""

    staged: bool
    sentence: str
    megabytes: float
    seconds: float


def own_s() -> float:
    """Read a clock that stands still while this process waits for a processor that other programs use."""
    stat = Path("/proc/self/schedstat")  # not every kernel has it
    waited_ns = int(stat.read_text().split()[1]) if stat.exists() else 0
    return time.monotonic() - waited_ns / 1e9


def judge(path: Path, folder: Path, proof: bool) -> tuple[bool, str, float, float]:
    """Stage an artifact, and run it if `proof`; return the values of an Outcome. Needs a process of its own."""
    signal.alarm(30)  # ends a process that waits for ever, which takes no CPU time
    resource.setrlimit(resource.RLIMIT_CPU, (20, 20))
    os.chdir(folder)
    before_mb, start, staged, sentence = Host().process_peak_memory_mb(), own_s(), False, ""
    try:
        releases = Releases(folder / "models", expected=EITHER)
        name = releases.stage(path).name
        staged = True
        if proof:
            confine(memory_mb(path, 1))
            releases.verify(name)
    except RoverError as error:
        sentence = str(error)
    except BaseException as error:
        sentence = f"UNFORESEEN {type(error).__name__}: {error}"
    return staged, sentence, Host().process_peak_memory_mb() - before_mb, own_s() - start


def serve() -> None:
    """Answer each line of the input, a JSON list of judge()'s arguments, with one that holds what it returned."""
    for line in sys.stdin:
        path, folder, proof = json.loads(line)
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.write(writing, json.dumps(judge(Path(path), Path(folder), proof)).encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            answer = pipe.read()
        _, status = os.waitpid(pid, 0)
        print(answer or json.dumps([False, f"UNFORESEEN: it ended with {status}", 0.0, 0.0]), flush=True)


@pytest.fixture(scope="module")
def judged():
    """judged(path, proof) judges an artifact, or a folder that was packed, in a process forked from a new interpreter.

    Not from this one, where a fork could use memory that earlier tests have freed, beyond its limit, and wait for ever
    for a lock that another thread held at that moment.
    """
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command = [sys.executable, __file__]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:

        def ask(path: Path, proof: bool = False) -> Outcome:
            print(json.dumps([str(path), str(path.parent), proof]), file=server.stdin, flush=True)
            return Outcome(*json.loads(server.stdout.readline()))

        yield ask
        server.stdin.close()


@pytest.fixture
def refused(judged):
    """refused(path, message) asserts that an artifact is refused cheaply, with a sentence that contains `message`, and
    that nothing harmful was run. staged: whether it is only refused when it is run, after staging has accepted it.
    """

    def check(path: Path, message: str, *, staged: bool = False) -> None:
        outcome = judged(path, proof=staged)
        assert message in outcome.sentence and "\n" not in outcome.sentence, outcome
        assert outcome.staged == staged, outcome
        assert outcome.megabytes < MOST_MB and outcome.seconds < MOST_S, outcome
        assert not list(path.parent.rglob(HARM)), outcome

    return check


def hostile(artifacts, folder: Path, change: dict[str, Edit], add: dict[str, bytes] | None = None) -> Path:
    return rewritten(artifacts["fp32"], folder / "hostile.pt", change, add)


# Operators, and a program of another form

LINES = {  # each is inserted before the end of a program, whose answer is y
    "map a file and write to it": ('torch.add_(torch.from_file("harm", True, 4), 1)', "character '\"'"),
    "map a file, its name a number": ("h = torch.from_file(7, True, 4)", "found torch.from_file"),
    "save a tensor to a file": ('torch.save(y, "harm")', "character '\"'"),
    "save, as an assignment": ("h = torch.save(y, y)", "found torch.save"),
    "print": ("print(y)", "found print(y)"),
    "raise": ("ops.prim.RaiseException(y)", "found ops.prim.RaiseException(y)"),
    "loop for ever": ("while True:\n      y = torch.add(y, 0)", "found while True"),
    "write in place": ("y = torch.mul_(y, 0)", "found torch.mul_"),
    "another library's operator": ("h = ops.rover.open(y)", "found ops.rover.open"),
    "a quantized operator of others": ("h = ops.quantized.embedding_byte_unpack(y)", "found ops.quantized.embedding"),
    "start another thread": ("h = fork(y)", "found fork"),
    "its own method": ("h = (self).forward(y, y)", "found self.forward"),
    "a method of a tensor": ("h = (y).tolist()", "found y.tolist"),
    "an attribute of a constant": ("h = CONSTANTS.c0.data", "found CONSTANTS.c0.data"),
    "a name called torch": ("torch = y", "found a variable called torch"),
    "a keyword": ("h = torch.add(y, y, alpha=2)", "found torch.add(y, y, alpha=2)"),
    "a comment, which torch reads as a type": ("h = y # type: int", "character '#'"),
    "another alphabet": ("h\u00e4 = y", "character"),
    "an escape": ("h = \\\n    y", "character '\\\\'"),
    "a size beyond all": ("h = torch.as_strided(y, [100000000000, 1], [0, 0])", "found 100000000000"),
    "brackets without end": (f"h = {'[' * 3000}{']' * 3000}", "cannot be read"),
    "two statements in a line": ("h = y; h = y", "character ';'"),
    "a value that it does not have": ("h = torch.add(y, unknown)", "found unknown"),
}


def line_before_end(line: str) -> Edit:
    def edit(source: bytes) -> bytes:
        head, end = source.decode().rstrip().rsplit("    return ", 1)
        return f"{head}    y = {end}\n    {line}\n    return y\n".encode()

    return edit


SETSTATE = """
  def __setstate__(self, state: Dict[str, int]) -> None:
    torch.save(1, "harm")
"""


PROGRAMS = {
    "a method that torch.jit.load calls": (lambda s: s + SETSTATE.encode(), "character '\"'"),
    "a second method": (lambda s: s + b"  def more(self) -> int:\n    return 1\n", "a class with"),
    "a second class": (lambda s: s + b"class Other(Module):\n  pass\n", "more than a class"),
    "another kind of class": (lambda s: s.replace(b"(Module)", b"(NamedTuple)"), "more than a class"),
    "an argument that is a number": (lambda s: s.replace(b"frame: Tensor", b"frame: int"), "no tensor"),
    "attributes": (lambda s: s.replace(b"__buffers__", b"weights"), "a class with"),
    "no program": (lambda s: b"", "found 0 programs"),
    "another encoding": (lambda s: b"\xff\xfe" + s, "character"),
}


# Pickles: constants of the program, from which torch.jit.load makes tensors


class Harmful:
    def __reduce__(self):
        return os.system, (f"touch {HARM}",)


def swap(old: bytes, new: bytes) -> Edit:
    def edit(raw: bytes) -> bytes:
        assert old in raw
        return raw.replace(old, new, 1)

    return edit


def an_altered_reader(raw: bytes) -> bytes:
    """Give the function that makes tensors new default values for its arguments."""
    return b"\x80\2c" + NAME[1:] + b"(N}X\x0c\0\0\0__defaults__(K\1K\2tstb."


NAME, CLASS = b"ctorch._utils\n_rebuild_tensor_v2\n", b"c__torch__.rover_lib.workshop.act"
PICKLES = {  # what -> (record, edit, message)
    "a command in data.pkl": ("/data.pkl", lambda raw: pickle.dumps(Harmful(), 2), "found posix.system"),
    "a command in the constants": ("constants.pkl", swap(NAME, b"cos\nsystem\n"), "found os.system"),
    "a command in the source positions": (".debug_pkl", lambda raw: pickle.dumps(Harmful(), 2), "posix.system"),
    "a newer pickle": ("constants.pkl", lambda raw: pickle.dumps((Harmful(),), 4), "a pickle with FRAME"),
    "a class of others": ("/data.pkl", swap(CLASS, b"c__torch__.harm"), "found __torch__.harm"),
    "an attribute": ("/data.pkl", swap(b"}(u", b"}(X\1\0\0\0aK\1u"), "found attributes, {'a': 1}"),
    "a tensor larger than its bytes": ("constants.pkl", swap(b"K@K\2t", b"K\xffK\2t"), "a tensor of [255, 2] on 128"),
    "strides beyond its bytes": ("constants.pkl", swap(b"K\2K\1t", b"M\xff\xffK\1t"), "a tensor of [64, 2] on 128"),
    "strides before its bytes": ("constants.pkl", swap(b"K\2K\1t", b"J\xff\xff\xff\xffK\1t"), "of another form"),
    "an offset beyond its bytes": ("constants.pkl", swap(b"Qq\5K\0(", b"Qq\5K\1("), "a tensor of [64, 2] on 128"),
    "bytes that are not there": ("constants.pkl", swap(b"K\x80tQ", b"J\0\0\0\x7ftQ"), "a tensor without its bytes"),
    "another device": ("constants.pkl", swap(b"\3\0\0\0cpu", b"\4\0\0\0cuda"), "a tensor without its bytes"),
    "items of another size": ("constants.pkl", swap(b"FloatStorage", b"DoubleStorage"), "without its bytes"),
    "room for two billion": ("constants.pkl", swap(NAME + b"q\0", NAME + b"r\0\0\0\x7f"), "LONG_BINPUT"),
    "another reader": ("/data.pkl", an_altered_reader, "cannot be read"),
    "an end before the end": ("constants.pkl", lambda raw: raw[: len(raw) // 2], "cannot be read"),
    "no pickle": ("constants.pkl", lambda raw: b"", "cannot be read"),
}


PACKED_WEIGHTS = {
    "a linear layer's": (swap(b"Conv2dPackedParamsBase", b"LinearPackedParamsBase"), "a linear layer in another form"),
    "another library's": (
        swap(b"torch.classes.quantized\nConv2d", b"torch.classes.rover\nConv2d"), "found __torch__.torch.classes.rover"
    ),
    "no scheme": (swap(b"ctorch\nper_channel_affine\n", b"ctorch\nFloatStorage\n"), "quantized tensor of another form"),
    "another list": (swap(b"List[Optional[Tensor]]", b"List[Optional[Future]]"), "a list of List[Optional[Future]]"),
}  # fmt: skip


@pytest.mark.parametrize("what", PACKED_WEIGHTS)
def test_no_quantized_weights_of_another_form_are_packed(artifacts, tmp_path, refused, what):
    edit, message = PACKED_WEIGHTS[what]
    refused(rewritten(artifacts["static"], tmp_path / "x.pt", {"constants.pkl": edit}), message)


# Archives: names, and readers that would see different things


@pytest.mark.parametrize(
    "name",
    ["archive/../../harm", "/harm", "archive/model.json", "archive/data/0", "archive/code/__torch__/../x.py",
     "other/data.pkl", "archive/attributes.pkl", "archive/extra/harm.so", "archive/constants/harm", "archive/"],
)  # fmt: skip
def test_no_other_record_is_taken(artifacts, tmp_path, refused, name):
    refused(hostile(artifacts, tmp_path, {}, {name: b"harm"}), "a record that no artifact has, found")


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("name", ["data.pkl", "constants.pkl", "code/__torch__/rover_lib/workshop/ACT.py"])
def test_no_record_is_there_twice_whatever_its_case(artifacts, tmp_path, refused, name):
    change = {"": lambda raw: raw}
    with zipfile.ZipFile(artifacts["fp32"]) as z:
        (program,) = [n for n in z.namelist() if n.endswith(".py")]
    twice = f"archive/{name}" if "code" not in name else program.replace("rover_lib", "Rover_Lib")
    refused(hostile(artifacts, tmp_path, change, {twice: b"harm"}), "is in it twice")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        pytest.param(lambda raw: b"\0\0\0\0PTMF" + raw, "does not begin as an archive", id="a phone's format"),
        pytest.param(lambda raw: raw + b"harm", "does not end as an archive", id="something after it"),
        pytest.param(lambda raw: raw[:-2] + b"\4\0harm", "does not end as an archive", id="a comment"),
        pytest.param(lambda raw: raw[:4] + bytes(4096) + raw[4:], "directory is not where it says", id="a gap"),
        pytest.param(lambda raw: raw[:4] + bytes(60) + raw[-22:], "directory is not where it says", id="no directory"),
        pytest.param(lambda raw: raw[: len(raw) // 2], "does not end as an archive", id="half of it"),
        pytest.param(lambda raw: b"", "does not begin as an archive", id="nothing"),
    ],
)
def test_no_other_file_is_taken(artifacts, tmp_path, refused, edit, message):
    path = hostile(artifacts, tmp_path, {})
    path.write_bytes(edit(path.read_bytes()))
    refused(path, message)


# Bombs


BOMB_MB = 321  # whose four bytes stand in no other header


def deflated(artifacts, folder: Path, name: str) -> Path:
    """Return an artifact in which a record is replaced by zeros, which are compressed a thousandfold."""
    path = hostile(artifacts, folder, {name: lambda raw: None})
    with (
        zipfile.ZipFile(artifacts["fp32"]) as z,
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as new,
    ):
        (full,) = [n for n in z.namelist() if n.endswith(name)]
        with new.open(full, "w", force_zip64=False) as record:
            for _ in range(BOMB_MB):
                record.write(bytes(1 << 20))
    return path


@pytest.mark.parametrize("name", ["extra/manifest.json", ".py"])
def test_a_bomb_is_known_by_its_header(artifacts, tmp_path, refused, name):
    path = deflated(artifacts, tmp_path, name)
    assert path.stat().st_size < artifacts["fp32"].stat().st_size + 3e6
    refused(path, f"unpacks to {BOMB_MB << 20} bytes")
    # And a bomb whose header lies.
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", BOMB_MB << 20), struct.pack("<I", 9000)))
    refused(path, "is compressed" if "manifest" in name else "damaged")


def inner_bomb(raw: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as z:
        for name in ("state.npy", "chunk.npy", "frame_cam_front.npy"):
            with z.open(name, "w") as f:
                np.lib.format.write_array_header_1_0(f, {"descr": "|u1", "fortran_order": False, "shape": (1 << 40,)})
                for _ in range(BOMB_MB if name == "state.npy" else 1):
                    f.write(bytes(1 << 20))
    return out.getvalue()


def pickled(raw: bytes) -> bytes:
    out = io.BytesIO()
    np.savez(out, state=np.array([Harmful()], object), chunk=np.zeros(1), frame_cam_front=np.zeros(1))
    return out.getvalue()


VECTORS = {
    "a bomb": (inner_bomb, "too large"),
    "a pickle": (pickled, "another shape than its manifest says"),
    "too many": (vectors_with(lambda v: v.update({k: np.repeat(x, 50, 0) for k, x in v.items()})), "too large"),
    "none": (vectors_with(lambda v: v.update({k: x[:0] for k, x in v.items()})), "another shape"),
    "other lengths": (vectors_with(lambda v: v.update(state=v["state"][:1])), "do not belong together"),
    "no answers": (vectors_with(lambda v: v.pop("chunk")), "not readable"),
    "answers that are no numbers": (vectors_with(lambda v: v["chunk"].fill(np.nan)), "do not belong together"),
    "a row too many": (vectors_with(lambda v: v.update(chunk=v["chunk"].repeat(2, 1))), "another shape"),
    "another type": (vectors_with(lambda v: v.update(state=v["state"].astype(float))), "another shape"),
    "other pictures": (vectors_with(lambda v: v.update(frame_cam_front=v["frame_cam_front"][:, :9])), "another shape"),
}


def test_many_records_are_not_listed(artifacts, tmp_path, refused):
    many = {f"archive/constants/{i + 1000}": b"" for i in range(6000)}
    refused(hostile(artifacts, tmp_path, {}, many), "records are more than an artifact has")


def test_a_record_of_gigabytes_is_not_believed(artifacts, tmp_path, refused):
    path = hostile(artifacts, tmp_path, {})
    with zipfile.ZipFile(path) as z:
        size = max(r.file_size for r in z.infolist())
    path.write_bytes(path.read_bytes().replace(struct.pack("<II", size, size), struct.pack("<II", 4 << 29, 4 << 29)))
    refused(path, "bytes are more than an artifact has")


# Lies of the manifest


MANIFESTS = [
    ({"parity": {"tolerance": {"steering": 1e9, "throttle": 1e9}}}, "steering must be from 0 to 0.001"),
    ({"parity": {"tolerance": {"steering": 0.0, "throttle": float("nan")}}}, "tolerance of throttle must be"),
    ({"parity": {"tolerance": {"steering": 0.0, "throttle": "1"}}}, "tolerance of throttle must be"),
    ({"parity": {"tolerance": {"steering": -1.0, "throttle": 0.0}}}, "tolerance of steering must be"),
    ({"mode": "static", "parity": {"tolerance": {"steering": 0.5, "throttle": 0}}}, "must be from 0 to 0.3"),
    ({"mode": "static"}, "its manifest says static, its code is not"),
    ({"mode": "quick"}, "mode must be one of"),
    ({"scheme": "ternary"}, "scheme must be one of"),
    ({"engine": "x86"}, "needs the engine 'x86'"),
    ({"rate_hz": 0.01}, "rate_hz must be from 5 to 120, found 0.01"),
    ({"rate_hz": 1e6}, "rate_hz must be from 5 to 120"),
    ({"rate_hz": float("inf")}, "rate_hz must be from 5 to 120"),
    ({"rate_hz": True}, "rate_hz must be from 5 to 120"),
    ({"chunk": 32_000}, "chunk must be from 1 to 256, found 32000"),
    ({"chunk": True}, "chunk must be from 1 to 256"),
    ({"chunk": "32"}, "manifest key 'chunk'"),
    ({"chunk": ...}, "manifest key 'chunk'"),
    ({"schema": 99}, "schema 99"),
    ({"cameras": []}, "has no cameras"),
    ({"cameras": [{"name": "cam_front"}]}, "lacks name, height or width"),
    ({"cameras": [{"name": ["cam"], "height": 72, "width": 128}]}, "is not a name and a size"),
    ({"state_names": []}, "state_names must be names"),
    ({"action_names": [["steering"]]}, "action_names must be names"),
    ({"action_names": ["steering"]}, "tolerance"),
    ({"weights_mb": -1}, "weights_mb must be from 0"),
    ({"gmac": float("nan")}, "gmac must be from 0"),
    ({"cameras": [{"name": "cam_front", "height": 1, "width": 2}]}, "is not a name and a size"),
    ({"cameras": [{"name": "cam_front", "height": 72_000, "width": 128_000}]}, "is not a name and a size"),
    ({"cameras": [{"name": "../harm", "height": 72, "width": 128}]}, "is not a name and a size"),
    ({"cameras": [{"name": "cam_front", "height": 72, "width": 128}] * 2}, "cameras must be names, each once"),
    ({"cameras": [{"name": "cam_front", "height": 144, "width": 256}]}, "another shape than its manifest says"),
    ({"action_names": ["throttle", "steering"]}, "this car has steering and throttle"),
    ({"action_names": ["steering", "throttle"] * 2}, "action_names must be names, each once"),
    ({"state_names": ["steering\x1b[2J", "throttle"]}, "holds text that cannot be printed, found 'steering"),
    ({"state_names": ["a" * 10_000]}, "state_names must be names"),
    ({"versions": {"torch": "9.9"}}, "made with torch 9.9"),
    ({"versions": {}}, "made with torch ?"),
    ({"versions": {"torch": "2.8\x1b[2J"}}, "holds text that cannot be printed, found '2.8\\x1b[2J'"),
    ({"versions": {"torch": "2.8", "\x1b[2J": ""}}, "holds text that cannot be printed"),
    ({"normalisation": "\ud800"}, "holds text that cannot be printed"),
    ({"checkpoint": {"sha256": json.loads("[" * 900 + "]" * 900)}}, "nested more than 8 deep"),
    ({"checkpoint": "harm"}, "manifest key 'checkpoint'"),
]  # fmt: skip
NO_MANIFESTS = [b"[" * 50_000, b'{"a":' * 10_000, b"[]", b"", b"\xff"]

RECORDS = {  # what -> (record, edit, message)
    **{what: (".py", line_before_end(line), message) for what, (line, message) in LINES.items()},
    **{what: (".py", *row) for what, row in PROGRAMS.items()},
    **PICKLES,
    **{f"{what} in the parity vectors": ("parity.npz", *row) for what, row in VECTORS.items()},
    **{f"manifest {i}": ("manifest.json", manifest_with(**values), says) for i, (values, says) in enumerate(MANIFESTS)},
    "no manifest": ("manifest.json", lambda _: None, "manifest.json"),
    "no parity vectors": ("parity.npz", lambda _: None, "parity.npz"),
    **{f"no manifest {i}": ("manifest.json", lambda _, t=t: t, "manifest is no") for i, t in enumerate(NO_MANIFESTS)},
}


@pytest.mark.parametrize("what", RECORDS)
def test_no_record_of_another_form_is_believed(artifacts, tmp_path, refused, what):
    record, edit, message = RECORDS[what]
    refused(hostile(artifacts, tmp_path, {record: edit}), message)


# What only running it finds: it has the right form, so that it is staged, but it is never used


ANSWERS = {
    "three columns": ("y = torch.cat([y, torch.slice(y, 2, 0, 1)], 2)", "found (1, 32, 3)"),
    "four columns": ("y = torch.cat([y, y], 2)", "must give 32 times 2 float32, found (1, 32, 4)"),
    "32,000 rows": ("y = torch.as_strided(y, [1, 32000, 2], [0, 0, 1])", "found (1, 32000, 2)"),
    "a batch of two": ("y = torch.cat([y, y], 0)", "found (2, 32, 2)"),
    "one row": ("y = torch.slice(y, 1, 0, 1)", "found (1, 1, 2)"),
    "no batch": ("y = torch.squeeze(y, 0)", "found (32, 2)"),
    "doubles": ("y = torch.to(y, 7)", "found (1, 32, 2) float64"),
    "bytes beyond the end": ("y = torch.as_strided(y, [1, 32, 2], [64, 200, 1])", "do not run"),
    "other answers": ("y = torch.mul(y, 2)", "computes something else here"),
    "half of a terabyte": ("y = torch.contiguous(torch.as_strided(y, [1, 10000000, 10000], [0, 0, 0]))", "do not run"),
    "memory that doubles": ("\n    ".join(["y = torch.cat([y, y], 0)"] * 40), "do not run"),
    "memory that grows": ("\n    ".join([
        *(f"h{i} = torch.contiguous(torch.as_strided(y, [1000000, 10], [0, 0], {i}))" for i in range(30)),
        f"y = torch.cat([{', '.join(f'h{i}' for i in range(30))}], 0)",
    ]), "do not run"),
}  # fmt: skip


@pytest.mark.parametrize("what", ANSWERS)
def test_an_answer_is_what_the_manifest_says(artifacts, tmp_path, refused, what):
    line, message = ANSWERS[what]
    path = hostile(artifacts, tmp_path, {".py": line_before_end(line)})
    refused(path, message, staged=True)


# What is no file


def a_fifo(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (a_fifo, "not a file"),
        (lambda path: path.symlink_to("/dev/zero"), "not a file"),
        (Path.mkdir, "not a file"),
        (lambda path: path.symlink_to("nothing"), "not a file"),
    ],
    ids=["a FIFO", "a device", "an empty folder", "nothing"],
)
def test_what_is_no_artifact_is_not_waited_for(tmp_path, refused, make, message):
    make(tmp_path / "x")
    refused(tmp_path / "x", message)


def test_names_that_look_like_torchs_counter_are_kept_in_the_content_hash(artifacts, tmp_path):
    """They were dropped from it, so that two programs could have one hash."""
    hashes = {artifact.content_hash(artifacts["static"])}
    for name in (b"x___torch_mangle_1", b"x___torch_mangle_2", b"x"):
        with zipfile.ZipFile(artifacts["static"]) as z:
            program = next(r.filename for r in z.infolist() if r.filename.endswith(".py") and r.file_size)
        changes = {program.removeprefix("archive/"): lambda raw, name=name: raw.replace(b"input", name, 1)}
        hashes.add(artifact.content_hash(rewritten(artifacts["static"], tmp_path / "other.pt", changes)))
    assert len(hashes) == 4


# Root


def test_root_loads_nothing_unless_there_is_nobody_else(artifacts, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.delenv("ROVER_AS_ROOT")
    with pytest.raises(ArtifactError, match="root does not load artifacts; use another user, on a rover `sudo -u"):
        load_policy(artifacts["static"])


def test_what_is_refused_above_is_of_our_own_form_otherwise(artifacts, tmp_path, judged):
    """This shows that each row is refused for its own reason."""
    for mode in artifacts:
        load_policy(rewritten(artifacts[mode], tmp_path / f"{mode}.pt", {}))
    outcome = judged(hostile(artifacts, tmp_path, {".py": line_before_end("y = torch.add(y, 0)")}), proof=True)
    assert (outcome.staged, outcome.sentence) == (True, "")


if __name__ == "__main__":
    serve()
