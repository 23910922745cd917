"""What a confined process can still do, on this machine's kernel."""

import ctypes
import json
import os
import pty
import subprocess
import sys

from rover_lib.onboard.policy import confine

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

def by_number(number):
    if libc.syscall(number) < 0:
        raise OSError(ctypes.get_errno(), "refused")

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
asked("rename a file", lambda: os.rename(f"{folder}/there", f"{folder}/else"))
asked("make a link", lambda: os.symlink("/", f"{folder}/made"))
asked("make a socket", lambda: socket.socket(socket.AF_UNIX).close())
asked("make a network socket", lambda: socket.socket().close())
asked("start a program", lambda: subprocess.run(["true"]))
asked("become a program", lambda: os.execv("/bin/true", ["true"]))
asked("fork", lambda: os.fork() or os._exit(0))
asked("signal another", lambda: os.kill(other, 0))
asked("change a mode", lambda: os.chmod(f"{folder}/there", 0o777))
asked("change another's limits", lambda: resource.prlimit(other, resource.RLIMIT_CORE))
asked("ask by x32's number", lambda: by_number(39 | 1 << 30))  # the other numbering on x86-64
in_a_thread("make a file from a thread", lambda: os.open(f"{folder}/made", os.O_WRONLY | os.O_CREAT))
asked("read a file", lambda: open(f"{folder}/there").read())
asked("take some memory", lambda: bytearray(50 << 20))
asked("take much memory", lambda: bytearray(400 << 20))
in_a_thread("start a thread", lambda: None)
asked("change its own limits", lambda: resource.prlimit(0, resource.RLIMIT_CORE))
forbid_opening()
asked("read a file at the end", lambda: open(f"{folder}/there").read())
asked("read what is open", lambda: os.read(opened, 1))
print(json.dumps({"reason": reason, "found": found}))
"""
WORKS = {"read a file", "take some memory", "start a thread", "change its own limits", "read what is open"}


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
    assert (found["take much memory"], found["ask by x32's number"]) == ("MemoryError", "PermissionError")
    assert [p.name for p in tmp_path.iterdir()] == ["there"] and (tmp_path / "there").read_text() == "there"


def test_the_library_knows_each_call():
    """A name that it does not know would be refused, here or on a Pi, where nobody has tried it."""
    library = ctypes.CDLL(confine.LIBRARY)
    for processor in (0xC000003E, 0xC00000B7):  # SCMP_ARCH_X86_64, SCMP_ARCH_AARCH64
        for name in (*confine.ALLOWED, *confine.ALLOWED_IF, "clone3"):
            number = library.seccomp_syscall_resolve_name_arch(ctypes.c_uint32(processor), name.encode())
            assert number != -1, name


def test_without_the_library_it_says_so(monkeypatch):
    monkeypatch.setattr(confine, "LIBRARY", "libnone.so")
    monkeypatch.setattr(confine, "_lower", lambda *_: None)  # of this process
    assert "libseccomp2" in confine.confine(200)
