"""Confine a process that runs an artifact: it may compute, read files, and answer through files that it has open.

Nobody can tell what an artifact's program does. So before a process runs it, it gives up every right that a policy does
not need: it can no longer open a file for writing, the serial port or a socket, start a program, or touch another
process, and its memory has a limit. libseccomp makes the kernel's filter of system calls.
"""

import ctypes
import errno
import os
import resource
from pathlib import Path

from rover_lib.onboard.errors import ArtifactError

# Memory of an inference beside torch itself: activations, weights in two forms, stacks of threads. The full-size policy
# takes 183 MB of it in INT8 (a file of 68 MB) and 334 in FP32 (261), measured on x86-64.
MEMORY_MB, MEMORY_PER_FILE, THREAD_MB = 80, 2.5, 20
AS_ROOT = "ROVER_AS_ROOT"  # the services unset it: roles/rover/templates/sandbox.j2

LIBRARY = "libseccomp.so.2"  # on each Debian and Ubuntu, whose apt needs it; what follows is of its seccomp.h
ALLOW, REFUSE = 0x7FFF0000, 0x00050000  # actions; REFUSE | errno
BAD_NUMBERS, ALL_THREADS, MASKED_EQUAL = 2, 4, 7  # SCMP_FLTATR_ACT_BADARCH, SCMP_FLTATR_CTL_TSYNC, SCMP_CMP_MASKED_EQ
ALLOWED = (
    "futex", "read", "write", "sched_yield", "mmap", "munmap", "mprotect", "madvise", "mremap", "brk",
    "clock_gettime", "clock_getres", "clock_nanosleep", "nanosleep", "gettimeofday", "close", "fstat", "newfstatat",
    "statx", "stat", "lstat", "access", "faccessat", "faccessat2", "readlink", "readlinkat", "lseek", "pread64",
    "readv", "writev", "getdents64", "getcwd", "rt_sigaction", "rt_sigprocmask", "rt_sigreturn", "sigaltstack",
    "getpid", "gettid", "getuid", "geteuid", "getgid", "getegid", "uname", "sysinfo", "getrusage", "times",
    "sched_getaffinity", "getcpu", "set_robust_list", "rseq", "set_tid_address", "getrandom", "membarrier",
    "restart_syscall", "exit", "exit_group",
)  # fmt: skip
TO_WRITE = os.O_ACCMODE | os.O_CREAT | os.O_TRUNC  # a file opened with any of these bits is not only read
CLONE_THREAD = 0x10000
# Allowed by one of its arguments: which, a mask, and what it must be under the mask
ALLOWED_IF = {
    "open": (1, TO_WRITE, 0),
    "openat": (2, TO_WRITE, 0),
    "clone": (0, CLONE_THREAD, CLONE_THREAD),
    "prlimit64": (0, 0xFFFFFFFF, 0),  # for this process itself
}


class _Condition(ctypes.Structure):
    """struct scmp_arg_cmp of libseccomp."""

    _fields_ = (
        ("argument", ctypes.c_uint), ("comparison", ctypes.c_int), ("mask", ctypes.c_uint64), ("value", ctypes.c_uint64)
    )  # fmt: skip


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


def confine(limit_mb: float) -> str:
    """Give up every right that an inference does not need: in all threads of this process, and for good.

    limit_mb: memory that the process may allocate from now on, so import torch first. Returns "", or the reason why the
    kernel cannot filter the system calls; the limit of memory holds in any case.
    """
    data_kib = int(Path("/proc/self/status").read_text().partition("VmData:")[2].split()[0])
    _lower(resource.RLIMIT_DATA, data_kib * 1024 + int(limit_mb * 1e6))
    _lower(resource.RLIMIT_CORE, 0)
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError:
        return f"there is no {LIBRARY}, of the package libseccomp2"
    library.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.seccomp_init(REFUSE | errno.EPERM))
    codes = [library.seccomp_attr_set(context, BAD_NUMBERS, REFUSE | errno.EPERM)]  # of another processor
    codes.append(library.seccomp_attr_set(context, ALL_THREADS, 1))  # also those that torch has started

    def add(name: str, action: int = ALLOW, *conditions: _Condition) -> None:
        number = library.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:  # else this processor has no such call
            array = (_Condition * len(conditions))(*conditions)
            codes.append(library.seccomp_rule_add_array(context, action, number, len(conditions), array))

    for name in ALLOWED:
        add(name)
    for name, (argument, mask, value) in ALLOWED_IF.items():
        add(name, ALLOW, _Condition(argument, MASKED_EQUAL, mask, value))
    add("clone3", REFUSE | errno.ENOSYS)  # its flags are in memory; the C library then takes clone
    failed = next((code for code in codes if code), 0) or library.seccomp_load(context)
    library.seccomp_release(context)
    return f"the kernel takes no filter of system calls ({os.strerror(-failed)})" if failed else ""


def forbid_opening() -> None:
    """Forbid this process to open any file from now on, even for reading."""
    _lower(resource.RLIMIT_NOFILE, 0)


def _lower(limit: int, value: int) -> None:
    maximum = resource.getrlimit(limit)[1]
    if maximum != resource.RLIM_INFINITY:
        value = min(value, maximum)
    resource.setrlimit(limit, (value, value))
