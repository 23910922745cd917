"""What a confined process can still do: on this machine's kernel, and according to each processor's filter."""

import json
import os
import platform
import pty
import re
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.policy import confine

ALLOWED, REFUSED, UNKNOWN = confine.ALLOW, confine.REFUSE | confine.EPERM, confine.REFUSE | confine.ENOSYS
HEADERS = {
    "x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
    "aarch64": Path("/usr/include/asm-generic/unistd.h"),
}
here = pytest.mark.skipif(platform.machine() not in confine.PROCESSORS, reason="no filter for this processor")

PROGRAM = r"""
import ctypes, json, os, resource, signal, socket, subprocess, sys, threading, time
from rover_lib.onboard.policy.confine import confine, forbid_opening

port, folder, other = sys.argv[1], sys.argv[2], int(sys.argv[3])
libc = ctypes.CDLL(None, use_errno=True)
opened = os.open(os.devnull, os.O_RDONLY)
waiting = threading.Event()
found = {}

def asked(name, action):
    try:
        action()
        found[name] = "works"
    except BaseException as error:
        found[name] = type(error).__name__

def in_a_thread(name, action):
    thread = threading.Thread(target=asked, args=(name, action))
    thread.start()
    thread.join()

def of_before():  # a thread that was there when the process was confined
    waiting.wait()
    asked("make a file from a thread of before", lambda: os.open(f"{folder}/made", os.O_WRONLY | os.O_CREAT))

thread = threading.Thread(target=of_before)
thread.start()
reason = confine(200)
waiting.set()
thread.join()
asked("open the port to write", lambda: os.open(port, os.O_RDWR | os.O_NOCTTY))
asked("make a file", lambda: os.open(f"{folder}/made", os.O_WRONLY | os.O_CREAT))
asked("empty a file", lambda: os.open(f"{folder}/there", os.O_RDONLY | os.O_TRUNC))
asked("remove a file", lambda: os.unlink(f"{folder}/there"))
asked("make a socket", lambda: socket.socket(socket.AF_UNIX).close())
asked("start a program", lambda: subprocess.run(["true"]))
asked("fork", lambda: os.fork() or os._exit(0))
asked("signal another", lambda: os.kill(other, 0))
asked("change another's limits", lambda: resource.prlimit(other, resource.RLIMIT_CORE))
in_a_thread("make a file from a thread", lambda: os.open(f"{folder}/made", os.O_WRONLY | os.O_CREAT))
asked("read a file", lambda: open(f"{folder}/there").read())
asked("take some memory", lambda: bytearray(50 << 20))
asked("take much memory", lambda: bytearray(400 << 20))
in_a_thread("start a thread", lambda: None)
forbid_opening()
asked("read a file at the end", lambda: open(f"{folder}/there").read())
asked("read what is open", lambda: os.read(opened, 1))
print(json.dumps({"reason": reason, "found": found}))
"""
WORKS = {"read a file", "take some memory", "start a thread", "read what is open"}


@here
def test_a_confined_process_computes_and_does_nothing_else(tmp_path):
    (tmp_path / "there").write_text("there")
    master, slave = pty.openpty()
    try:
        command = [sys.executable, "-c", PROGRAM, os.ttyname(slave), tmp_path, str(os.getpid())]
        done = subprocess.run(command, capture_output=True, text=True)
    finally:
        os.close(master)
        os.close(slave)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["reason"] == ""
    found = told["found"]
    assert {name for name, what in found.items() if what == "works"} == WORKS
    assert len(found) > 12 and found["take much memory"] == "MemoryError"
    assert [p.name for p in tmp_path.iterdir()] == ["there"] and (tmp_path / "there").read_text() == "there"


def judged(processor: str, call: tuple[int | None, ...] | int, *arguments: int, architecture: int | None = None) -> int:
    """Return the filter's answer to a system call, by interpreting the four kinds of instructions that it has."""
    column, own = confine.PROCESSORS[processor]
    number = call if isinstance(call, int) else call[column]
    given = (*arguments, *([0] * (6 - len(arguments))))
    data = struct.pack("<IIQ6Q", number, own if architecture is None else architecture, 0, *given)
    program, at, word = confine.filter_of(processor), 0, 0
    while True:
        code, if_true, if_false, value = struct.unpack_from("<HBBI", program, 8 * at)
        at += 1
        if code == confine.RETURN:
            return value
        if code == confine.LOAD:
            (word,) = struct.unpack_from("<I", data, value)
        else:
            holds = word == value if code == confine.JUMP_EQUAL else bool(word & value)
            at += if_true if holds else if_false


@pytest.mark.parametrize("processor", confine.PROCESSORS)
def test_the_filter_of_each_processor(processor):
    column, _ = confine.PROCESSORS[processor]
    for call in confine.ALLOWED.values():
        if call[column] is not None:
            assert judged(processor, call) == ALLOWED
            assert judged(processor, call, architecture=0x40000003) == REFUSED  # another processor's numbers
            assert judged(processor, call[column] | 1 << 30) == REFUSED  # x32, the other numbering on x86-64
    assert judged(processor, confine.OPENAT, 0, 0, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW) == ALLOWED
    for flags in (os.O_WRONLY, os.O_RDWR, os.O_CREAT, os.O_TRUNC, os.O_RDWR | os.O_NOCTTY, 0o20200001):
        assert judged(processor, confine.OPENAT, 0, 0, flags) == REFUSED
    assert judged(processor, confine.CLONE, 0x3D0F00) == ALLOWED  # the flags of pthread_create
    assert judged(processor, confine.CLONE, 17) == judged(processor, confine.CLONE, 0x4111) == REFUSED  # fork, vfork
    assert judged(processor, confine.CLONE3) == UNKNOWN
    assert judged(processor, confine.PRLIMIT, 0) == ALLOWED and judged(processor, confine.PRLIMIT, 1) == REFUSED
    known = {call[column] for call in confine.ALLOWED.values()}
    known |= {call[column] for call in (confine.OPEN, confine.OPENAT, confine.CLONE, confine.CLONE3, confine.PRLIMIT)}
    for number in set(range(600)) - known:
        assert judged(processor, number) == REFUSED


@pytest.mark.parametrize("processor", confine.PROCESSORS)
def test_the_numbers_are_the_kernels(processor):
    if not HEADERS[processor].exists():
        pytest.skip(f"no {HEADERS[processor]}: apt install linux-libc-dev")
    text = HEADERS[processor].read_text()
    numbers = {m[1]: int(m[2]) for m in re.finditer(r"#define __NR(?:3264)?_(\w+)\s+(\d+)", text)}
    numbers["newfstatat"] = numbers.get("newfstatat", numbers.get("fstatat"))
    given = {**confine.ALLOWED, "openat": confine.OPENAT, "clone": confine.CLONE, "clone3": confine.CLONE3,
             "prlimit64": confine.PRLIMIT, "seccomp": confine.SECCOMP, "open": confine.OPEN}  # fmt: skip
    column, _ = confine.PROCESSORS[processor]
    ours = {name: call[column] for name, call in given.items() if call[column] is not None}
    assert ours.items() <= numbers.items()
