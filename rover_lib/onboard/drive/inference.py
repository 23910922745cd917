"""Plan while the control loop runs: a thread asks the policy for a plan of the newest frame, again and again.

    with PolicyProcess("policy_static.pt") as policy:
        with Planner(camera, policy.predict, commanded, policy.rate_hz) as planner:
            plan = planner.newest()

The policy has a process of its own, so that it cannot delay the control loop, and can be killed if it hangs.
"""

import contextlib
import ctypes
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.artifact.engines import UNCONFINED
from rover_lib.onboard.artifact.manifest import Artifact, read_manifest
from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.drive.plan import LIMITS, Commanded, Plan
from rover_lib.onboard.errors import ArtifactError, PolicyError, RoverError
from rover_lib.onboard.policy.confine import confine, forbid_opening, memory_mb

LOAD_S = 120.0  # time to load an engine and a full-size policy from a slow card
POLL_S = 0.05
WAIT_S = 0.1
FRESH_S = 0.8  # longest wait for a fresh plan: WatchdogSec of the service is 2 s, and the Arduino has to answer too
END_S = 1.0
NICE = 5  # the control loop goes first
PR_SET_PDEATHSIG = 1
ANSWER_BYTES = 100_000
_REQUEST = struct.Struct("<IIff")  # height, width, state

Predict = Callable[[np.ndarray, np.ndarray], np.ndarray]  # frame (h, w, 3) uint8 BGR, state (2,) -> (chunk, 2)


class Planner:
    """Plans for the newest frame again and again, in a thread; a context manager.

    predict: returns (chunk, 2) actions, unclipped, for a frame and a state, or raises. rate_hz: actions per
    second of a plan. rest_s: pause after each plan, except in without_rest(), so that a standing car does not get warm.
    limits: of the actions, see Plan.
    """

    def __init__(
        self,
        camera: Camera,
        predict: Predict,
        commanded: Commanded,
        rate_hz: float,
        *,
        rest_s: float = 0.0,
        limits: np.ndarray = LIMITS,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._limits = limits
        self._camera, self._predict, self._commanded, self._rate_hz = camera, predict, commanded, rate_hz
        self._rest_s, self._clock = rest_s, clock
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
        plan = self.newest()
        number = plan.number if plan else 0
        if plan and self._clock() - plan.captured_s <= age_s:
            return
        plan = self.wait(FRESH_S, after=number)
        if not plan or plan.number == number:
            raise PolicyError(f"no fresh plan within {FRESH_S:g} s", remedy="is this machine too busy?")

    @property
    def asking_s(self) -> float:
        """Seconds that the policy has been computing its present answer for; 0 while it is idle."""
        asked = self._asked_s
        return 0.0 if asked is None else self._clock() - asked

    def _run(self) -> None:
        number = frame_number = 0
        try:
            while not self._closing.is_set():
                frame = self._camera.wait(frame_number, WAIT_S)
                if frame is None:
                    continue
                frame_number = frame.number
                state = self._commanded.state(frame.captured_s, self._rate_hz)
                self._asked_s = self._clock()
                actions = self._predict(frame.image, state)
                self._asked_s = None
                number += 1
                plan = Plan(number, frame.captured_s, self._clock(), actions, self._limits)
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

    With a process, the loop's commands were 1.4 to 3.5 ms late at p99, and with a thread instead of it 5.4 to 6.3 ms
    (measured on a workstation at commit 7343b87, which could do both).

    artifact: a file, or an open Artifact whose manifest need not be read again. threads: of the engine; None: all cores
    but one, which is left for the loop. Raises PolicyError, with the sentence
    of the ArtifactError, if the artifact cannot be used here.

    The artifact is not trusted. So the process is confined (see confine.py), and its answers are accepted only if they
    have the shape that the manifest gives, which is read in this process. unconfined: why the kernel cannot confine the
    process, "" if it does.
    """

    program = __name__  # the module that the process runs

    def __init__(self, artifact: Path | str | Artifact, *, threads: int | None = None):
        self._source = artifact
        self.artifact = artifact.path if isinstance(artifact, Artifact) else Path(artifact)
        self.threads = threads or max(1, (os.cpu_count() or 1) - 1)
        self.manifest: dict[str, Any] = {}
        self.unconfined = ""
        self._process: subprocess.Popen | None = None
        self._pipe: Connection | None = None
        self._closing = threading.Event()

    def __enter__(self) -> "PolicyProcess":
        try:
            given = self._source
            self.manifest = given.manifest if isinstance(given, Artifact) else read_manifest(given)
        except ArtifactError as error:
            raise PolicyError(error.what, found=error.found, remedy=error.remedy) from None
        ours, theirs = Pipe()
        command = [sys.executable, "-m", self.program, str(theirs.fileno()), str(self.artifact), str(self.threads)]
        # A session of its own, so that the terminal's Ctrl-C comes to the loop alone, which stops the car first.
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True
        )
        theirs.close()
        self._pipe = ours
        try:
            self.unconfined = self._answer(LOAD_S).decode(errors="replace")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closing.set()
        if self._process:
            self._process.terminate()
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._pipe:
            with contextlib.suppress(OSError):
                self._pipe.close()

    @property
    def rate_hz(self) -> float:
        """Actions per second of a chunk."""
        return float(self.manifest["rate_hz"])

    @property
    def chunk(self) -> int:
        """Number of actions in a plan."""
        return int(self.manifest["chunk"])

    @property
    def pids(self) -> tuple[int, ...]:
        """The id of the policy's process; empty if none runs."""
        return (self._process.pid,) if self._process else ()

    def predict(self, frame_bgr: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return (chunk, 2) float32 as Policy.predict_unclipped() does, for one camera. close() ends the wait for it.

        Raises PolicyError with the policy's own error, or if its process has ended.
        """
        pipe, frame = self._open_pipe(), np.ascontiguousarray(frame_bgr)
        try:
            pipe.send_bytes(_REQUEST.pack(*frame.shape[:2], *map(float, state)))
            pipe.send_bytes(frame.data.cast("B"))
        except (OSError, ValueError) as error:
            raise self._ended() from error
        answer = np.frombuffer(self._answer(None), np.uint8)
        if answer.size != 4 * 2 * self.chunk:
            raise PolicyError(f"{self.artifact}: {answer.size} bytes are no plan of {self.chunk} actions")
        return answer.view(np.float32).reshape(self.chunk, 2)

    def _open_pipe(self) -> Connection:
        if self._pipe is None:
            raise PolicyError(
                f"{self.artifact}: its process was not started", remedy="use it as `with PolicyProcess(...) as policy:`"
            )
        return self._pipe

    def _answer(self, timeout_s: float | None) -> bytes:
        pipe = self._open_pipe()
        end = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            while not pipe.poll(POLL_S):
                if self._closing.is_set():
                    raise PolicyError(f"{self.artifact}: the policy was closed")
                if end and time.monotonic() > end:
                    raise PolicyError(
                        f"{self.artifact}: not loaded within {timeout_s:g} s", remedy="is the memory full?"
                    )
            answer = pipe.recv_bytes(ANSWER_BYTES)
        except (EOFError, OSError) as error:
            raise self._ended() from error
        if answer[:1] == b"!":
            raise PolicyError(**json.loads(answer[1:]))
        return answer[1:]

    def _ended(self) -> PolicyError:
        code = None
        if self._process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self._process.wait(END_S)
        how = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        return PolicyError(f"{self.artifact}: the policy's process ended ({how})", remedy="is there enough memory?")


def delay(predict: Predict, latency_s: float) -> Predict:
    """Return a `predict` whose answers take at least latency_s each."""

    def predict_delayed(frame_bgr: np.ndarray, state: np.ndarray) -> np.ndarray:
        end = time.monotonic() + latency_s
        try:
            return predict(frame_bgr, state)
        finally:
            time.sleep(max(0.0, end - time.monotonic()))

    return predict_delayed


def serve(pipe: Connection, artifact: str, threads: int, loaded: Callable[[Any], None] = lambda policy: None) -> None:
    """Run the policy's process: answer each request until the other side closes the pipe.

    An answer is "=" and bytes, or "!" and the fields of an error as JSON. The bytes of the first answer say why the
    process is not confined, those of all others are chunks. loaded: called with the loaded policy; used by the
    laboratory to make policies misbehave.
    """
    with contextlib.suppress(EOFError, OSError):
        try:
            # Here, because the process that drives must load no engine; and before the limits, which an engine exceeds.
            from rover_lib.onboard.policy.load import import_engine, load_policy

            with Artifact(artifact) as opened:
                unconfined = UNCONFINED.get(import_engine(opened)) or confine(memory_mb(artifact, threads))
                policy = load_policy(opened, threads=threads)
            names = list(policy.state_names), list(policy.action_names)
            if names != (["steering", "throttle"],) * 2 or len(policy.cameras) != 1:
                raise PolicyError(
                    f"{artifact}: takes {names[0]} and {len(policy.cameras)} cameras and gives {names[1]}",
                    remedy="this car has one camera, steering and throttle, by these names (quantize: --action-names)",
                )
            loaded(policy)
            forbid_opening()
        except RoverError as error:
            return pipe.send_bytes(_refusal(error))
        except Exception as error:
            what = f"{artifact}: cannot be loaded ({type(error).__name__}: {error})"
            return pipe.send_bytes(_refusal(PolicyError(what)))
        pipe.send_bytes(b"=" + unconfined.encode())
        while True:
            height, width, *state = _REQUEST.unpack(pipe.recv_bytes())
            frame = np.frombuffer(pipe.recv_bytes(), np.uint8).reshape(height, width, 3)
            try:
                chunk = policy.predict_unclipped(frame, np.array(state, np.float32))
            except RoverError as error:
                pipe.send_bytes(_refusal(error))
            except Exception as error:
                what = " ".join(str(error).split())[-300:]
                failed = PolicyError(f"{artifact}: inference failed ({type(error).__name__}: {what})")
                pipe.send_bytes(_refusal(failed))
            else:
                pipe.send_bytes(b"=" + np.ascontiguousarray(chunk, np.float32).tobytes())


def _refusal(error: RoverError) -> bytes:
    found = None if error.found is None else str(error.found)
    return b"!" + json.dumps({"what": error.what, "found": found, "remedy": error.remedy}).encode()


def main(arguments: list[str], loaded: Callable[[Any], None] = lambda policy: None) -> None:
    """Run as the program that PolicyProcess starts. arguments: its pipe, artifact and threads. loaded: see serve()."""
    fd, artifact, threads = arguments
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a policy that hangs must not outlive the loop
    os.nice(NICE)
    serve(Connection(int(fd)), artifact, int(threads), loaded)


if __name__ == "__main__":
    main(sys.argv[1:])
