"""Plan while the control loop runs: a thread keeps asking the policy for a plan of the newest frame.

    with PolicyProcess("policy_static.pt") as policy, Planner(camera, policy, commanded) as planner:
        plan = planner.newest()

The policy has a process of its own, so that it cannot delay the control loop, and can be killed if it hangs.
"""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.artifact.manifest import Artifact, read_manifest
from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.drive.plan import LIMITS, Commanded, Plan
from rover_lib.onboard.errors import ArtifactError, PolicyError, RoverError
from rover_lib.onboard.policy.confine import forbid_opening

LOAD_S = 120.0  # time to load an engine and a full-size policy from a slow card
POLL_S = 0.05
WAIT_S = 0.1
FRESH_S = 0.8  # longest wait for a fresh plan: WatchdogSec of the service is 2 s, and the Arduino has to answer too
END_S = 1.0
NICE = 5  # the control loop goes first
PR_SET_PDEATHSIG = 1
ANSWER_BYTES = 100_000
UNTOLD = 99.0  # Plan.strange where the process tells no number, which a page could not show
TERMINALS = {signal.SIGINT, signal.SIGHUP, signal.SIGQUIT}  # signals of a terminal to all its programs


class Planner:
    """Keeps planning from the newest frame, in a thread; a context manager.

    rest_s: pause after each plan, except in without_rest(). latency_s: the least time that a plan takes. limits: see
    Plan.
    """

    def __init__(
        self,
        camera: Camera,
        policy: "PolicyProcess",
        commanded: Commanded,
        *,
        rest_s: float = 0.0,
        latency_s: float = 0.0,
        limits: np.ndarray = LIMITS,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._camera = camera
        self._policy = policy
        self._commanded = commanded
        self._rest_s = rest_s
        self._latency_s = latency_s
        self._limits = limits
        self._clock = clock
        self._closing = threading.Event()
        self._no_rest = threading.Event()
        self._news = threading.Condition()
        self._plan: Plan | None = None
        self._failure: RoverError | None = None
        self._asked_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="planner", daemon=True)

    def __enter__(self) -> "Planner":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._closing.set()
        self._no_rest.set()
        if self._thread.is_alive():
            self._thread.join(END_S)

    def newest(self) -> Plan | None:
        """Return the newest plan, None before the first. Raises what the camera or the policy raised."""
        if self._failure:
            raise self._failure
        return self._plan

    def wait(self, timeout_s: float, after: int = 0) -> Plan | None:
        """Wait for a plan numbered above `after`, or until the time is over. Returns and raises as newest() does."""
        with self._news:
            self._news.wait_for(lambda: self._failure or (self._plan and self._plan.number > after), timeout_s)
        return self.newest()

    @contextlib.contextmanager
    def without_rest(self) -> Iterator[None]:
        """Inside this context, plans follow each other without a pause."""
        self._no_rest.set()
        try:
            yield
        finally:
            self._no_rest.clear()

    def renew(self, age_s: float) -> None:
        """If the newest plan's frame is older than age_s, wait for the next plan. For use in without_rest().

        Raises PolicyError if none comes within FRESH_S, and what newest() raises.
        """
        before = self.newest()
        if before and self._clock() - before.captured_s <= age_s:
            return
        if self.wait(FRESH_S, after=before.number if before else 0) is before:
            raise PolicyError(f"no fresh plan within {FRESH_S:g} s", remedy="is this machine too busy?")

    @property
    def asking_s(self) -> float:
        """Seconds that the policy has been computing its present answer for; 0 while it is idle."""
        asked_s = self._asked_s
        return 0.0 if asked_s is None else self._clock() - asked_s

    def _run(self) -> None:
        number = frame_number = 0
        try:
            while not self._closing.is_set():
                frame = self._camera.wait(frame_number, WAIT_S)
                if frame is None:
                    continue
                frame_number = frame.number
                state = self._commanded.state(frame.captured_s, self._policy.rate_hz)
                asked_s = self._asked_s = self._clock()
                actions = self._policy.predict(frame.image, state)
                time.sleep(max(0.0, asked_s + self._latency_s - self._clock()))
                self._asked_s = None
                number += 1
                plan = Plan(number, frame.captured_s, self._clock(), actions, self._limits, self._policy.strange)
                with self._news:
                    self._plan = plan
                    self._news.notify_all()
                self._no_rest.wait(self._rest_s)
        except RoverError as error:
            self._failure = error
        except Exception as error:  # of any type: the loop must be told, and stop the car
            self._failure = PolicyError(f"the policy failed ({type(error).__name__}: {error}); the car is stopped")
        with self._news:
            self._news.notify_all()


class PolicyProcess:
    """An artifact in a process of its own; a context manager. Only one thread at a time may call predict().

    artifact: a file, or an open Artifact. threads: of the engine; None: all cores but one, which is left for the loop.
    Raises PolicyError if the artifact cannot be used here. unconfined: why the kernel cannot confine the process, "" if
    it does. chunk: number of actions in a plan, of which there are rate_hz per second. strange: Plan.strange of the
    newest prediction; None if the artifact has no threshold.

    The artifact is not trusted: the process is confined (confine.py), and nothing that it sends is unpickled. An answer
    must have the size that the manifest gives, which is read in this process.
    """

    def __init__(self, artifact: Path | str | Artifact, *, threads: int | None = None):
        self._source = artifact
        self.artifact = artifact.path if isinstance(artifact, Artifact) else Path(artifact)
        self.threads = threads or max(1, (os.cpu_count() or 1) - 1)
        self.manifest: dict[str, Any] = {}
        self.rate_hz = 0.0
        self.chunk = 0
        self.unconfined = ""
        self.strange: float | None = None
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._closing = threading.Event()

    def __enter__(self) -> "PolicyProcess":
        try:
            source = self._source
            self.manifest = source.manifest if isinstance(source, Artifact) else read_manifest(source)
        except ArtifactError as error:
            raise PolicyError(error.what, found=error.found, remedy=error.remedy) from None
        self.rate_hz = float(self.manifest["rate_hz"])
        self.chunk = int(self.manifest["chunk"])
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        arguments = theirs, str(self.artifact), self.threads
        self._process = spawn.Process(target=serve, args=arguments, name="policy", daemon=True)
        try:
            self._process.start()
            theirs.close()
            self.unconfined = self._answer(LOAD_S).decode(errors="replace")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._closing.set()
        if self._process and self._process.pid:
            self._process.terminate()
            self._process.join(END_S)
            self._process.kill()
            self._process.join()
        if self._pipe:
            self._pipe.close()

    def predict(self, frame_bgr: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return (chunk, 2) float32 as Policy.predict_unclipped() does, for one camera. close() ends the wait for it.

        Raises PolicyError with the policy's own error, or if its process has ended.
        """
        assert self._pipe, "it is open"
        frame = np.ascontiguousarray(frame_bgr)
        try:
            self._pipe.send((frame.shape, [float(value) for value in state]))
            self._pipe.send_bytes(frame.data.cast("B"))
        except (OSError, ValueError) as error:
            raise self._ended() from error
        answer = np.frombuffer(self._answer(None), np.uint8)
        tells = "familiar" in self.manifest
        if answer.size != 4 * (2 * self.chunk + tells):
            raise PolicyError(f"{self.artifact}: unexpected size of a plan", found=f"{answer.size} bytes")
        values = answer.view(np.float32)
        self.strange = float(np.nan_to_num(values[-1], nan=UNTOLD, posinf=UNTOLD)) if tells else None
        return values[: 2 * self.chunk].reshape(self.chunk, 2)

    def _answer(self, timeout_s: float | None) -> bytes:
        assert self._pipe, "it is open"
        end = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            while not self._pipe.poll(POLL_S):
                if self._closing.is_set():
                    raise PolicyError(f"{self.artifact}: the policy was closed")
                if end and time.monotonic() > end:
                    raise PolicyError(f"{self.artifact}: not loaded in time", found=f"{timeout_s:g} s")
            answer = self._pipe.recv_bytes(ANSWER_BYTES)
        except (EOFError, OSError) as error:
            raise self._ended() from error
        if answer[:1] == b"!":
            raise PolicyError(answer[1:].decode(errors="replace"))
        return answer[1:]

    def _ended(self) -> PolicyError:
        assert self._process, "it was started"
        self._process.join(END_S)
        code = self._process.exitcode
        cause = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        return PolicyError(f"{self.artifact}: the policy's process ended ({cause})", remedy="is there enough memory?")


def serve(pipe: Connection, artifact: str, threads: int) -> None:
    """Run the policy's process: answer each request until the other side closes the pipe.

    An answer is "=" and bytes, or "!" and an error's sentence. The first says why the process is not confined.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a policy that hangs must not outlive the loop
    os.nice(NICE)
    for number in TERMINALS:  # Ctrl-C is for the loop alone, which stops the car first
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(EOFError, OSError):
        try:
            policy, unconfined = _load_confined(artifact, threads)
            forbid_opening()
        except Exception as error:
            return pipe.send_bytes(_refusal(f"{artifact}: cannot be loaded", error))
        pipe.send_bytes(b"=" + unconfined.encode())
        while True:
            shape, state = pipe.recv()
            frame = np.frombuffer(pipe.recv_bytes(), np.uint8).reshape(shape)
            try:
                chunk = policy.predict_unclipped(frame, np.array(state, np.float32))
                strange = [] if policy.strange is None else [policy.strange]
                answer = b"=" + np.array([*chunk.flat, *strange], np.float32).tobytes()
            except Exception as error:
                answer = _refusal(f"{artifact}: inference failed", error)
            pipe.send_bytes(answer)


def _load_confined(artifact: str, threads: int) -> tuple[Any, str]:
    """Confine this process, load a policy, and return it and why the process is not confined. Raises RoverError."""
    from rover_lib.onboard.policy.confined import load_confined  # here: the process that drives must load no engine

    reasons: list[str] = []
    policies, _ = load_confined({"policy": artifact}, threads=threads, notify=reasons.append)
    policy = policies["policy"]
    names = list(policy.state_names), list(policy.action_names)
    if names != (["steering", "throttle"],) * 2 or len(policy.cameras) != 1:
        problem = f"{artifact}: takes {names[0]} and {len(policy.cameras)} cameras and gives {names[1]}"
        raise PolicyError(problem, remedy="this car has one camera, steering and throttle (rover run: --action-names)")
    return policy, "".join(reasons)


def _refusal(what: str, error: Exception) -> bytes:
    text = str(error) if isinstance(error, RoverError) else f"{what} ({type(error).__name__}: {str(error)[-300:]})"
    return b"!" + " ".join(text.split()).encode()
