"""Confine a process that runs an artifact: it may compute, read files, and answer through files that it has open.

    reason = confine(memory_mb("policy_static.pt", threads=3))    # "" if the kernel enforces it, otherwise why not

Nobody can tell what an artifact's program does. So before a process runs it, it gives up every right that a policy does
not need: it can no longer open a file for writing, the serial port or a socket, start a program, or touch another
process, and its memory has a limit.
"""

import ctypes
import os
import platform
import resource
import struct
from pathlib import Path

from rover_lib.onboard.errors import ArtifactError

# Memory of an inference beside torch itself: activations, weights in two forms, stacks of threads. The full-size policy
# takes 183 MB of it in INT8 (a file of 68 MB) and 334 in FP32 (261), measured on x86-64.
MEMORY_MB, MEMORY_PER_FILE, THREAD_MB = 80, 2.5, 20
AS_ROOT = "ROVER_AS_ROOT"  # the services unset it: roles/rover/templates/sandbox.j2
PR_SET_NO_NEW_PRIVS = 38
SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC = 1, 1  # TSYNC: for all threads, also those that torch has started

# Numbers of system calls: (x86_64, aarch64), from linux/arch/x86/entry/syscalls/syscall_64.tbl and
# linux/include/uapi/asm-generic/unistd.h; None: that processor has none. The frequent ones first.
ALLOWED = {
    "futex": (202, 98), "read": (0, 63), "write": (1, 64), "sched_yield": (24, 124), "mmap": (9, 222),
    "munmap": (11, 215), "mprotect": (10, 226), "madvise": (28, 233), "mremap": (25, 216), "brk": (12, 214),
    "clock_gettime": (228, 113), "clock_getres": (229, 114), "clock_nanosleep": (230, 115), "nanosleep": (35, 101),
    "gettimeofday": (96, 169), "close": (3, 57), "fstat": (5, 80), "newfstatat": (262, 79), "statx": (332, 291),
    "stat": (4, None), "lstat": (6, None), "access": (21, None), "faccessat": (269, 48), "faccessat2": (439, 439),
    "readlink": (89, None), "readlinkat": (267, 78), "lseek": (8, 62), "pread64": (17, 67), "readv": (19, 65),
    "writev": (20, 66), "getdents64": (217, 61), "getcwd": (79, 17), "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135), "rt_sigreturn": (15, 139), "sigaltstack": (131, 132), "getpid": (39, 172),
    "gettid": (186, 178), "getuid": (102, 174), "geteuid": (107, 175), "getgid": (104, 176), "getegid": (108, 177),
    "uname": (63, 160), "sysinfo": (99, 179), "getrusage": (98, 165), "times": (100, 153),
    "sched_getaffinity": (204, 123), "getcpu": (309, 168), "set_robust_list": (273, 99), "rseq": (334, 293),
    "set_tid_address": (218, 96), "getrandom": (318, 278), "membarrier": (324, 283), "restart_syscall": (219, 128),
    "exit": (60, 93), "exit_group": (231, 94),
}  # fmt: skip
OPEN, OPENAT, CLONE, CLONE3, PRLIMIT, SECCOMP = (2, None), (257, 56), (56, 220), (435, 435), (302, 261), (317, 277)
# By processor: the column of its numbers above, and the kernel's number for its architecture
PROCESSORS = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
TO_WRITE = os.O_ACCMODE | os.O_CREAT | os.O_TRUNC  # a file opened with any of these bits is not only read
CLONE_THREAD = 0x10000
EPERM, ENOSYS = 1, 38
# Instructions of the kernel's filters: load a word of (number, architecture, address, six arguments), compare, return
LOAD, JUMP_EQUAL, JUMP_ANY_BIT, RETURN = 0x20, 0x15, 0x45, 0x06
ALLOW, REFUSE = 0x7FFF0000, 0x00050000  # REFUSE | errno


def refuse_root() -> None:
    """Raise ArtifactError if root runs this process, unless the environment (AS_ROOT) allows it."""
    if os.geteuid() == 0 and os.environ.get(AS_ROOT) != "1":
        raise ArtifactError(
            "root does not load artifacts",
            remedy=f"use another user, on a rover `sudo -u rover ...`; in a container without one, {AS_ROOT}=1",
        )


def memory_mb(artifact: Path | str, threads: int) -> float:
    """Return the megabytes of memory that a process may take to load an artifact and run it."""
    return MEMORY_MB + MEMORY_PER_FILE * Path(artifact).stat().st_size / 1e6 + THREAD_MB * threads


def filter_of(processor: str) -> bytes:
    """Return the kernel's filter for a processor of PROCESSORS: 8 bytes per instruction, see linux/filter.h."""
    column, architecture = PROCESSORS[processor]
    program = [_step(LOAD, 4), _step(JUMP_EQUAL, architecture, 1, 0), _step(RETURN, REFUSE | EPERM), _step(LOAD, 0)]

    def when(call: tuple[int | None, ...], *steps: bytes) -> None:
        if (number := call[column]) is not None:
            program.extend([_step(JUMP_EQUAL, number, 0, len(steps)), *steps])

    def if_argument(index: int, jump: bytes) -> list[bytes]:
        """Allow a call by one of its arguments. jump: skips one step, the refusal, if the argument is allowed."""
        return [_step(LOAD, 16 + 8 * index), jump, _step(RETURN, REFUSE | EPERM), _step(RETURN, ALLOW)]

    for call in ALLOWED.values():
        when(call, _step(RETURN, ALLOW))
    for call, flags in ((OPEN, 1), (OPENAT, 2)):
        when(call, *if_argument(flags, _step(JUMP_ANY_BIT, TO_WRITE, 0, 1)))
    when(CLONE, *if_argument(0, _step(JUMP_ANY_BIT, CLONE_THREAD, 1, 0)))
    when(CLONE3, _step(RETURN, REFUSE | ENOSYS))  # its flags are in memory; the C library then takes clone
    when(PRLIMIT, *if_argument(0, _step(JUMP_EQUAL, 0, 1, 0)))  # only for this process itself
    program.append(_step(RETURN, REFUSE | EPERM))
    return b"".join(program)


def _step(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("<HBBI", code, if_true, if_false, value)


def confine(limit_mb: float) -> str:
    """Give up every right that an inference does not need: in all threads of this process, and for good.

    limit_mb: memory that the process may allocate from now on, so import torch first. Returns "", or the reason why the
    kernel cannot filter the system calls; the limit of memory holds in any case.
    """
    _lower(resource.RLIMIT_DATA, _bytes_with(limit_mb))
    _lower(resource.RLIMIT_CORE, 0)
    processor = platform.machine()
    if processor not in PROCESSORS:
        return f"no filter of system calls is known for {processor}"
    program = filter_of(processor)
    steps = ctypes.create_string_buffer(program, len(program))
    described = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(steps))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        return f"the kernel does not let it give up privileges ({os.strerror(ctypes.get_errno())})"
    number = SECCOMP[PROCESSORS[processor][0]]
    if libc.syscall(number, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, described):
        return f"the kernel takes no filter of system calls ({os.strerror(ctypes.get_errno())})"
    return ""


def _bytes_with(limit_mb: float) -> int:
    """Return the size in bytes that this process's data will have once it has allocated limit_mb more."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmData:")[2].split()[0]) * 1024 + int(limit_mb * 1e6)


def forbid_opening() -> None:
    """Forbid this process to open any file from now on, even for reading."""
    _lower(resource.RLIMIT_NOFILE, 0)


def _lower(limit: int, value: int) -> None:
    most = resource.getrlimit(limit)[1]
    value = value if most == resource.RLIM_INFINITY else min(value, most)
    resource.setrlimit(limit, (value, value))
