"""The invariants: what must never happen in a drive, whatever else does.

    for sentence in broken(drive_story(story)):

This module knows what the human, the operator and the camera's pictures really did, and derives from that what is
allowed. The only statement of the code under test that it believes is the firmware's state.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lab.driving.virtual import HELD, LIVE, Hand, Seen
from rover_lib.onboard.drive.service import REQUEST_S

# What firmware/README.md and params.yml promise, with numbers that are written here anew.
RESTING_US = 124  # a throttle pulse up to this moves no car
REST_US = 120 + 32  # the largest throttle pulse of a stick at rest, as the firmware sees it
CAP_US = 238
SLEW_US_PER_MS = {"steering": 4, "throttle": 2}
# A command holds for at most 200 ms after the newest status that its host had read; then its throttle takes 65 to fall.
VALID_MS = 200 + 65
SIGNAL_MS = 105  # a lost signal, or a moved stick, is noticed within 100 ms, and a turn of the loop
DEAD_BAND_US = {"steering": 48 + 8, "throttle": 32 + 8}
STALE_MS = 1000 + VALID_MS  # drive.stop_s of params.yml, and then the last command's time
BLIND_MS = 250  # how long the car may drive by pictures that show nothing new
ASKED_MS = 1000 * REQUEST_S + 200  # from the operator's request to autonomous, including the line's way
GESTURE_MS = 30_000
# From a stop to the end of the drive. To find a silent link takes 0.5 s, and so does each of two unanswered neutrals.
ENDED_MS = 1700


@dataclass
class Run:
    """What was seen, as arrays with a value for each millisecond.

    live: whether the receiver's pulses are the human's. signals: whether there are pulses on both channels.
    """

    seen: Seen

    def __post_init__(self) -> None:
        seen, n = self.seen, self.seen.end_ms + 1
        pins = [(ms, e) for ms, e in seen.pins if ms < n]
        self.steering = _each_ms(pins, n, lambda e: e.steering_us if e else 0)
        self.throttle = _each_ms(pins, n, lambda e: e.throttle_us if e else 0)
        self.state = _each_ms(pins, n, lambda e: ord(e.state) if e else 0)
        self.live = _each_ms(seen.hands, n, lambda h: h.receiver == LIVE)
        self.stick = {
            "steering": _each_ms(seen.hands, n, lambda h: h.sticks[0]),
            "throttle": _each_ms(seen.hands, n, lambda h: h.sticks[1]),
        }
        self.signals = _each_ms(seen.hands, n, lambda h: all(h.pulses()))
        self.regular = _each_ms(seen.hands, n, lambda h: h.one_in == 1 and not h.misread_in)
        self.autonomous = self.state == ord("A")
        armed = np.flatnonzero(np.diff(self.autonomous.astype(int)) == 1) + 1
        left = np.flatnonzero(np.diff(self.autonomous.astype(int)) == -1) + 1
        self.armed, self.left = armed.tolist(), left.tolist()


def _each_ms(changes: list, n: int, value: Callable[[Any], Any]) -> np.ndarray:
    out = np.zeros(n, int)
    for (ms, what), (until, _) in pairwise([*changes, (n, None)]):
        out[ms:until] = value(what)
    return out


def _for_ms(holds: np.ndarray, ms: int) -> np.ndarray:
    """Return, for each millisecond, whether `holds` was true for the last `ms` milliseconds."""
    return np.convolve(holds, np.ones(ms), "full")[: len(holds)] >= ms - 0.5


def _first(bad: np.ndarray) -> int | None:
    return int(np.argmax(bad)) if bad.any() else None


def broken(seen: Seen) -> Iterator[str]:
    """Yield a sentence, with the millisecond, for each invariant that is broken."""
    run = Run(seen)
    for check in (_asked_for, _capped, _slewed, _not_blind, _human_wins, _human_keeps, _armed_by_people, _told):
        if (what := check(run)) is not None:
            yield f"{check.__name__[1:]}: {what}"


def _asked_for(run: Run) -> str | None:
    """The throttle is never above neutral unless a command of the host, or a live human, asked for it."""
    host, human = np.zeros_like(run.throttle), np.full_like(run.throttle, REST_US)
    for c in run.seen.commands:
        span = slice(c.at_ms, c.at_ms + VALID_MS)
        host[span] = np.maximum(host[span], c.throttle_us)
    for (start_ms, hand), (until, _) in pairwise([*run.seen.hands, (run.seen.end_ms + 1, Hand())]):
        if hand.receiver == LIVE:
            span, us = slice(start_ms, until + SIGNAL_MS + 25), hand.sticks[1]
        elif hand.receiver == HELD:  # nobody can tell this from a human, until the firmware starts anew: docs/safety.md
            next_start = min((s for s in run.seen.starts if s > start_ms), default=until)
            span, us = slice(start_ms, min(until, next_start) + SIGNAL_MS + 25), hand.sent[1]
        else:
            continue
        human[span] = np.maximum(human[span], us)
    bad = (run.throttle > RESTING_US) & (run.throttle > np.where(run.autonomous, host, human))
    if (ms := _first(bad)) is None:
        return None
    return f"throttle {run.throttle[ms]} us at {ms} ms in {chr(run.state[ms])}, asked for were {host[ms]}, {human[ms]}"


def _capped(run: Run) -> str | None:
    """The host's throttle is never above the cap."""
    ms = _first(run.autonomous & (run.throttle > CAP_US))
    return None if ms is None else f"throttle {run.throttle[ms]} us at {ms} ms"


def _slewed(run: Run) -> str | None:
    """The host moves no pin faster than the slew."""
    both = run.autonomous[1:] & run.autonomous[:-1]
    for pin, limit in SLEW_US_PER_MS.items():
        steps = np.abs(np.diff(getattr(run, pin)))
        if (ms := _first(both & (steps > limit))) is not None:
            return f"{pin} by {steps[ms]} us at {ms + 1} ms"
    return None


def _not_blind(run: Run) -> str | None:
    """The car drives by what was to be seen lately; by older pictures only for as long as it takes to notice."""
    content = np.zeros_like(run.throttle)
    for c in run.seen.commands:
        content[c.at_ms :] = c.content_ms if c.planned else 10**9
    age = np.arange(len(content)) - content
    blind = run.autonomous & (run.throttle > RESTING_US) & (age > STALE_MS)
    for armed, left in zip(run.armed, [*run.left, run.seen.end_ms], strict=False):
        if (count := int(blind[armed:left].sum())) > BLIND_MS:
            return f"{count} ms by pictures that were {int(age[armed:left][blind[armed:left]].max())} ms old"
    return None


def _human_wins(run: Run) -> str | None:
    """A moved stick, or a lost signal, ends autonomy within 100 ms."""
    for armed, left in zip(run.armed, [*run.left, run.seen.end_ms], strict=False):
        span, before = slice(armed, left), slice(max(0, armed - 45), armed + 1)
        moved = np.zeros(left - armed, bool)
        for channel, stick in run.stick.items():
            rests = np.unique(stick[before])
            moved |= np.abs(stick[span][:, None] - rests).min(1) > DEAD_BAND_US[channel]
        must_end = (moved & (run.live[span] == 1) & bool(run.live[before].all())) | (run.signals[span] == 0)
        for hung_ms, until_ms in run.seen.hung:  # a hung loop notices nothing; the watchdog ends that a little later
            must_end[max(0, hung_ms - armed) : max(0, until_ms - armed)] = False
        longest = ms = 0
        for i, must in enumerate(must_end):
            longest = longest + 1 if must else 0
            if longest > SIGNAL_MS:
                ms = armed + i
                return f"autonomous at {ms} ms, and for {longest} ms the human wanted the car, or was not there"
    return None


def _human_keeps(run: Run) -> str | None:
    """In manual the steering is the human's, as long as their signals come as they should."""
    good = (run.state == ord("M")) & (run.live == 1) & (run.signals == 1) & (run.regular == 1)
    for hung_ms, until_ms in run.seen.hung:
        good[hung_ms:until_ms] = False
    still = np.concatenate([[False], np.diff(run.stick["steering"]) == 0])
    good &= still
    ms = _first(_for_ms(good, 160) & (np.abs(run.steering - run.stick["steering"]) > 1))
    return None if ms is None else f"steering {run.steering[ms]} us at {ms} ms, the stick {run.stick['steering'][ms]}"


def _armed_by_people(run: Run) -> str | None:
    """Autonomous begins only by an operator's request since it last ended and a human's gesture since it last began."""
    lost = _for_ms(run.signals == 0, 130)[130:] & _for_ms(run.signals == 1, 130)[:-130]  # gone after it was there
    used = 0
    for armed in run.armed:
        stopped = max((ms for ms in run.left if ms < armed), default=-1)
        asked = [ms for ms in run.seen.asked if stopped < ms <= armed]
        if not asked or armed - asked[-1] > ASKED_MS:
            return f"armed at {armed} ms, asked for at {run.seen.asked}, stopped at {stopped}"
        since = max(
            [
                used,
                *(ms for ms in run.seen.starts if ms <= armed),
                *np.flatnonzero(lost[: max(0, armed - SIGNAL_MS)]).tolist(),
            ]
        )
        gestures = [ms for ms in run.seen.wiggled if since < ms <= armed and armed - ms <= GESTURE_MS]
        if not gestures:
            return f"armed at {armed} ms without a gesture since {since} ms (they were at {run.seen.wiggled})"
        used = armed
    return None


NAMED = re.compile(
    "took over|before it began|before a human armed|told to stop|transmitter|wiggled|at rest|was reset|no valid command"
    "|the host asked|the host paused|took no data|writing failed|reading failed|cannot be opened|no hello|no answer"
    "|said nothing|no status|not answered|no time|frozen|black|contrast|pictures in a row|no frame|ended after|too old"
    "|not finite|outside the range|told to fail|fresh plan|plan within|raised in the loop"
)
UNFORESEEN = re.compile(r"\w+(Error|Exception): (?!raised in the loop)")  # sentence_of()'s form for unforeseen errors


def _told(run: Run) -> str | None:
    """Each drive ends soon after the firmware has stopped the car, with a line that says why."""
    seen = run.seen
    for _, ms, words in seen.drives:
        if words is not None and (UNFORESEEN.match(words) or not NAMED.search(words)):
            return f"the drive that ended at {ms} ms says {words!r}"
    refused = [ms for ms, text in seen.log if text.startswith("not armed")]
    for left in run.left:
        if any(left - ENDED_MS <= ms <= left + ENDED_MS for ms in refused):
            continue  # the answer to arming was lost, so no drive began, and the firmware stopped without a command
        for begin, end, words in seen.drives:
            late = end - left > ENDED_MS + seen.paused_ms
            if begin <= left < end and late and words is not None:  # if it is None, the next start tells of it
                return f"stopped at {left} ms, and the drive ended at {end}"
    return None
