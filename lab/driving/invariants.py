"""The invariants: what must never happen in a drive, whatever else does.

    for sentence in broken(drive_story(story)):

This module knows what the human, the operator and the camera's pictures really did, and derives from that what is
allowed. The only statement of the code under test that it believes is the firmware's state.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lab.driving.virtual import DROPPING, GONE, HELD, LIVE, LOST, SILENT, Asked, Hand, Seen

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
SPARE_MS = 250  # a line's way, and turns of the loops
GESTURE_MS, SIDES_MS, LET_GO_MS = 30_000, 3000, 1000
SIDE_US, LET_GO_US = 200, 100 + 24
UNSEEN_MS = 350  # what a gamepad does is relayed and heard sooner, if its human is heard at all
GLIMPSE_MS = 30  # a stick that is back sooner may not have been seen, if few pulses come
NEUTRAL_US = {"steering": 1456, "throttle": 120}
STOP_MS = 250  # from what ends a drive to throttle off; if lines are lost, the firmware's time limit
FADE_MS = 500  # drive.fade_s of params.yml: by older pictures the host asks for less throttle
PLANNED_MS = 400  # a plan blends in within 100, and its commands hold for 265
PER_UNIT_US = {"steering": 555.7, "throttle": 591.2}
LIMIT = 0.2  # params.yml's throttle_limit
BLACK_FRAMES = 4
DRIVEN_US = 134  # a throttle from which on a car must move
STUCK_MS = 2000  # of throttle; drive.stuck_s of params.yml is 1.5 s
LOW_MS = 3000 + 1000 + 300  # drive.undervoltage_s of params.yml, the loop looks once a second, and ends
MISSING_MS = 200  # from the last picture to throttle off
UNANSWERED_MS = 150 + 50  # and a tick
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
        self.sick = _for_any(_each_ms(seen.sick, n, int) == 1, STOP_MS + 20)
        paused = np.zeros(n, bool)
        for start, end in [*seen.pauses, *((ms, ms + VALID_MS) for ms in seen.kills)]:
            paused[start:end] = True
        self.clean = ~self.sick & ~_for_any(paused, STOP_MS + 20)
        self.live = _each_ms(seen.hands, n, lambda h: h.receiver == LIVE)
        self.receiver, self.stick = {}, {}
        for i, pin in enumerate(NEUTRAL_US):
            self.receiver[pin] = _each_ms([(ms, hand.pulses()[i]) for ms, hand in seen.hands], n, int)
            self.stick[pin] = _each_ms([(ms, hand.sticks[i]) for ms, hand in seen.hands], n, int)
        self.signals = _each_ms(seen.hands, n, lambda h: all(h.pulses()))
        self.regular = _each_ms(seen.hands, n, lambda h: h.one_in == 1 and not h.misread_in)
        self.autonomous = self.state == ord("A")
        edges = np.diff(self.autonomous.astype(int))
        self.armed, self.left = ((np.flatnonzero(edges == way) + 1).tolist() for way in (1, -1))
        self.drives = list(zip(self.armed, [*self.left, n], strict=False))


def _each_ms(changes: list, n: int, value: Callable[[Any], Any]) -> np.ndarray:
    out = np.zeros(n, int)
    for (ms, change), (until, _) in pairwise([*changes, (n, None)]):
        out[ms:until] = value(change)
    return out


def _for_ms(holds: np.ndarray, ms: int) -> np.ndarray:
    """Return, for each millisecond, whether `holds` was true for the last `ms` milliseconds."""
    return np.convolve(holds, np.ones(ms), "full")[: len(holds)] >= ms - 0.5


def _for_any(holds: np.ndarray, ms: int) -> np.ndarray:
    """Return, for each millisecond, whether `holds` is true at any less than `ms` before or after it."""
    return np.convolve(holds, np.ones(2 * ms + 1), "same") > 0.5


def _first(bad: np.ndarray) -> int | None:
    return int(np.argmax(bad)) if bad.any() else None


def broken(seen: Seen) -> Iterator[str]:
    """Yield a sentence, with the millisecond, for each invariant that is broken."""
    run = Run(seen)
    checks = [_capped, _slewed, _not_blind, _told, _ends_when_told, _stopped_is_neutral, _as_planned, _bad_ends]
    checks += [_answered, _in_time, _stuck, _supplied]
    checks += [_armed_at_rest, _pad_lost] if seen.gamepad else [_asked_for, _human_wins, _human_keeps, _armed_by_people]
    for check in checks:
        if (problem := check(run)) is not None:
            yield f"{check.__name__[1:]}: {problem}"


def _asked_for(run: Run) -> str | None:
    """The throttle is never above neutral unless a command of the host, or a live human, asked for it."""
    host, human = np.zeros_like(run.throttle), np.full_like(run.throttle, REST_US)
    for c in run.seen.commands:
        span = slice(c.at_ms, c.at_ms + VALID_MS)
        host[span] = np.maximum(host[span], c.throttle_us)
    hands = run.seen.hands
    for (start_ms, hand), (until, _) in pairwise([*hands, (run.seen.end_ms + 1, hands[-1][1])]):
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
    for armed, end in run.drives:
        if (count := int(blind[armed:end].sum())) > BLIND_MS:
            return f"{count} ms by pictures that were {int(age[armed:end][blind[armed:end]].max())} ms old"
    return None


def _human_wins(run: Run) -> str | None:
    """A moved stick, or a lost signal, ends autonomy within 100 ms."""
    for armed, end in run.drives:
        span, before = slice(armed, end), slice(max(0, armed - 45), armed + 1)
        is_moved = np.zeros(end - armed, bool)
        for channel, stick in run.stick.items():
            rests = np.unique(stick[before])
            is_moved |= np.abs(stick[span][:, None] - rests).min(1) > DEAD_BAND_US[channel]
        must_end = (is_moved & (run.live[span] == 1) & bool(run.live[before].all())) | (run.signals[span] == 0)
        for hung_ms, until_ms in run.seen.hung:  # a hung loop notices nothing; the watchdog ends that a little later
            must_end[max(0, hung_ms - armed) : max(0, until_ms - armed)] = False
        if (late := _first(_for_ms(must_end, SIGNAL_MS + 1))) is not None:
            return f"autonomous at {armed + late} ms, and the human wanted the car for {SIGNAL_MS} ms, or was not there"
    return None


def _human_keeps(run: Run) -> str | None:
    """In manual the steering is the human's, as long as their signals come as they should."""
    good = (run.state == ord("M")) & (run.live == 1) & (run.signals == 1) & (run.regular == 1)
    for hung_ms, until_ms in run.seen.hung:
        good[hung_ms:until_ms] = False
    good[1:] &= np.diff(run.stick["steering"]) == 0
    ms = _first(_for_ms(good, 160) & (np.abs(run.steering - run.stick["steering"]) > 1))
    return None if ms is None else f"steering {run.steering[ms]} us at {ms} ms, the stick {run.stick['steering'][ms]}"


def _armed_by_people(run: Run) -> str | None:
    """Autonomous begins only by a young request since it last ended and a human's gesture since it last began.

    The gesture: the steering stick at both sides within three seconds, then let go for one, without any throttle.
    """
    lost = _for_ms(run.signals == 0, 130)[130:] & _for_ms(run.signals == 1, 130)[:-130]  # gone after it was there
    steering = run.receiver["steering"]
    off = np.where(steering > 0, steering - NEUTRAL_US["steering"], 0)
    throttle = run.receiver["throttle"]
    off_rest = _for_ms((throttle > 0) & (np.abs(throttle - NEUTRAL_US["throttle"]) > 32), GLIMPSE_MS)
    used = 0
    for armed in run.armed:
        stopped = max((ms for ms in run.left if ms < armed), default=-1)
        requests = [ms for ms in run.seen.asked if stopped < ms <= armed]
        if not requests or armed - requests[-1] > run.seen.asked_most_ms + SPARE_MS:
            return f"armed at {armed} ms, asked for at {run.seen.asked}, stopped at {stopped}"
        since = max(used, armed - GESTURE_MS - SIDES_MS - SPARE_MS)
        since = max([since, *(ms for ms in run.seen.starts if ms <= armed)])
        for ends_it in (lost[: max(0, armed - SIGNAL_MS)], off_rest[:armed]):
            since = max([since, *np.flatnonzero(ends_it)[-1:].tolist()])
        off_centre = np.abs(off[armed - LET_GO_MS + 60 : armed - 25]) > LET_GO_US
        sides = [np.flatnonzero(side[since:armed]) + since for side in (off <= -SIDE_US, off >= SIDE_US)]
        if _for_ms(off_centre, GLIMPSE_MS).any() or not any(ms <= SIDES_MS + 60 for ms in _gaps(*sides)):
            return f"armed at {armed} ms without a gesture since {since} ms"
        used = armed
    return None


def _armed_at_rest(run: Run) -> str | None:
    """A gamepad whose throttle is off rest, or whose L1 is up, arms nothing: what was never seen is not at rest."""
    off_rest = np.abs(run.stick["throttle"] - NEUTRAL_US["throttle"]) > DEAD_BAND_US["throttle"]
    let_go = _each_ms(run.seen.hands, len(off_rest), lambda hand: hand.receiver == LOST) == 1
    for fault, holds in (("off rest", off_rest), ("without L1", let_go)):
        for armed in run.armed:
            if _for_ms(holds, UNSEEN_MS)[armed]:
                return f"armed at {armed} ms with a gamepad's throttle {fault}"
    return None


def _pad_lost(run: Run) -> str | None:
    """A gamepad that is let go of, silent or gone ends autonomy."""

    def lost(hand: Hand) -> bool:
        return hand.pad in (GONE, SILENT) or (hand.receiver == LOST and hand.pad != DROPPING)

    must_end = _each_ms(run.seen.hands, len(run.throttle), lost) == 1
    for hung_ms, until_ms in run.seen.hung:
        must_end[hung_ms:until_ms] = False
    ms = _first(_for_ms(must_end, UNSEEN_MS) & run.autonomous)
    return None if ms is None else f"autonomous at {ms} ms, {UNSEEN_MS} ms without the gamepad"


def _gaps(left: np.ndarray, right: np.ndarray) -> Iterator[int]:
    """Yield how long after the one side the stick was at the other, each time."""
    for one, other in ((left, right), (right, left)):
        at = np.searchsorted(one, other) - 1
        yield from (other[at >= 0] - one[at[at >= 0]]).tolist()


def _off_after(run: Run, since_ms: int, limit_ms: int, what: str, until_ms: int = 10**9) -> str | None:
    """Say whether a drive that goes on at since_ms still moves the car limit_ms later, before until_ms."""
    for armed, end in run.drives:
        if armed <= since_ms < end:
            moving = np.flatnonzero(run.throttle[since_ms + limit_ms : min(end, until_ms)] > RESTING_US)
            if len(moving):
                return f"{what} at {since_ms} ms, and throttle at {since_ms + limit_ms + int(moving[0])}"
    return None


def _ends_when_told(run: Run) -> str | None:
    """A signal, the view, a limit or a missing heartbeat ends a drive: throttle off within 250 ms."""
    for ms, since in run.seen.stops:
        if ms < run.seen.end_ms and (not since or any(a <= since <= ms < b for a, b in run.drives)):
            limit_ms = STOP_MS if run.clean[ms] else VALID_MS + 20
            if problem := _off_after(run, ms, limit_ms, "told to stop"):
                return problem
    return None


def _stopped_is_neutral(run: Run) -> str | None:
    """In STOPPED both pins are at neutral."""
    for pin, neutral_us in NEUTRAL_US.items():
        if (ms := _first((run.state == ord("S")) & (getattr(run, pin) != neutral_us))) is not None:
            return f"{pin} at {getattr(run, pin)[ms]} us at {ms} ms"
    return None


def _as_planned(run: Run) -> str | None:
    """The host's pins are what the plans of the last 400 ms meant, within limit and fade, and so they stay."""
    n = len(run.throttle)
    good = [p for p in run.seen.plans if not p.bad]
    young = np.zeros(n, bool)
    for armed, _ in run.drives:
        young[armed : armed + PLANNED_MS] = True
    fresh = np.zeros(n, bool)
    for p in good:
        fresh[p.at_ms : p.at_ms + 200] = True
    for c in run.seen.commands:
        if c.at_ms - c.content_ms > FADE_MS:
            fresh[c.at_ms : c.at_ms + VALID_MS] = False
    well = run.clean & _for_ms(fresh, PLANNED_MS) & ~young & ~_for_any(young, PLANNED_MS)
    most_us = NEUTRAL_US["throttle"] + LIMIT * PER_UNIT_US["throttle"] + 1  # on the pins, the firmware's cap hides it
    if over := [c for c in run.seen.commands if c.throttle_us > most_us and c.planned]:
        return f"the host asks for throttle {over[0].throttle_us} us at {over[0].at_ms} ms"
    for i, (pin, neutral_us) in enumerate(NEUTRAL_US.items()):
        meant = [(p.at_ms, neutral_us + PER_UNIT_US[pin] * (min(p[2], LIMIT) if i else p[1])) for p in good]
        values = _each_ms([(0, neutral_us), *meant], n, round)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, (PLANNED_MS, 0), "edge"), PLANNED_MS + 1)
        low, high = windows.min(1), windows.max(1)
        low = np.where(young, np.minimum(low, neutral_us), low)
        high = np.where(young, np.maximum(high, neutral_us), high)
        pins, spoilt = getattr(run, pin), run.sick if i else np.zeros(n, bool)
        bad = run.autonomous & ~spoilt & ((pins > high + 4) | ((pins < low - 4) & (well if i else True)))
        if (ms := _first(bad)) is not None:
            return f"{pin} at {pins[ms]} us at {ms} ms, meant were {low[ms]} to {high[ms]}"
    return None


def _bad_ends(run: Run) -> str | None:
    """A plan that nobody may drive by, or black or missing pictures, end the drive's motion."""
    for p in run.seen.plans:
        if p.bad and (problem := _off_after(run, p.at_ms, VALID_MS + 20, "a bad plan")):
            return problem
    for (ms, _), (until, _) in pairwise([*run.seen.frames, (run.seen.end_ms, False)]):
        limit_ms = MISSING_MS if run.clean[ms] else MISSING_MS + VALID_MS
        if until - ms > limit_ms and (problem := _off_after(run, ms, limit_ms, "the last picture", until)):
            return problem
    blacks = 0
    for ms, black in run.seen.frames:
        blacks = blacks + 1 if black else 0
        if blacks == BLACK_FRAMES and (problem := _off_after(run, ms, VALID_MS + 20, "black pictures")):
            return problem
    return None


def _stuck(run: Run) -> str | None:
    """A car that stands although its throttle is on is stopped within two seconds, and no car that moves is."""
    stands = _each_ms(run.seen.stands, len(run.throttle), int) == 1
    for armed, drive_end in run.drives:
        still = np.concatenate([[False], (stands & run.clean)[armed:drive_end], [False]])
        on = (run.autonomous & (run.throttle > DRIVEN_US))[armed:drive_end]
        for begin, end in np.flatnonzero(np.diff(still)).reshape(-1, 2):
            if (count := int(on[begin:end].sum())) > STUCK_MS:
                return f"{count} ms of throttle until {armed + end} ms while the car stands"
    for _, ms, words in run.seen.drives:
        # The picture that it was judged by may be a tenth of a second old.
        if "does not move" in (words or "") and not stands[max(0, ms - 1400) : ms - 100].all():
            return f"stopped at {ms} ms as stuck, and it moved"
    return None


def _supplied(run: Run) -> str | None:
    """A supply that stays low ends a drive, and no other supply does."""
    low = _each_ms(run.seen.low, len(run.throttle), int) == 1
    ms = _first(_for_ms(low & run.autonomous & run.clean, LOW_MS) & (run.throttle > RESTING_US))
    if ms is not None:
        return f"throttle at {ms} ms, and the supply has been low for {LOW_MS} ms"
    for _, ms, words in run.seen.drives:
        if (words or "").startswith("under-voltage") and not low[max(0, ms - 1100) : ms].any():
            return f"stopped at {ms} ms for its supply, which was good"
    return None


def _answered(run: Run) -> str | None:
    """A drive that has had no answer for 150 ms sends nothing more."""
    heard, at = run.seen.heard, 0
    waiting: deque[Asked] = deque()
    for command in run.seen.commands:
        while at < len(heard) and heard[at][0] <= command.at_ms:
            while waiting and (heard[at][1] - waiting[0].sequence) % 2**32 < 2**31:
                waiting.popleft()
            at += 1
        while waiting and not any(a <= waiting[0].at_ms <= command.at_ms <= b + 1 for a, b in run.drives):
            waiting.popleft()  # of an earlier drive, or of an earlier start of the Arduino
        if waiting and command.at_ms - waiting[0].at_ms > UNANSWERED_MS:
            span = waiting[0].at_ms - 2, command.at_ms + 2
            if not any(start < span[1] and span[0] < end + 10 for start, end in run.seen.pauses):
                return f"a command at {command.at_ms} ms, and that of {waiting[0].at_ms} was not answered"
        waiting.append(command)
    return None


def _in_time(run: Run) -> str | None:
    """A host that pauses again and again ends its drive, or the Arduino does after 45 ms of a later pause."""
    pauses = sorted(run.seen.pauses)
    pauses = [p for p, later in pairwise([*pauses, (10**9, 0)]) if later[0] > p[1] + 15]
    for i, (start, end) in enumerate(pauses):
        begun = max((armed for armed in run.armed if armed <= end), default=end) + 40
        lateness = [b - a - 34 for a, b in pauses[: i + 1] if b > end - 480 and b - a >= 70 and a >= begun]
        if sum(lateness) > 160 and (problem := _off_after(run, end, VALID_MS + 20, "pauses until then")):
            return problem
        first = [b for a, b in pauses[:i] if 103 <= b - a <= 148 and b + 20 < start and end < b + 480]
        is_judged = first and end - start >= 48 and not run.sick[first[0] - 200 : end].any() and end < run.seen.end_ms
        if is_judged and any(a < first[0] - 150 and end + 2 < b for a, b in run.drives):
            return f"autonomous at {end} ms after a second pause"
    return None


UNFORESEEN = re.compile(r"\w+(Error|Exception): (?!raised in the loop)")  # sentence_of()'s form for unforeseen errors


def _told(run: Run) -> str | None:
    """Each drive ends soon after the firmware has stopped the car, with a line that says why."""
    seen = run.seen
    for _, ms, words in seen.drives:
        if words == "" or UNFORESEEN.match(words or ""):
            return f"the drive that ended at {ms} ms says {words!r}"
    refused = [ms for ms, text in seen.log if text.startswith("not armed")]
    for left in run.left:
        if any(left - ENDED_MS <= ms <= left + ENDED_MS for ms in refused):
            continue  # the answer to arming was lost, so no drive began, and the firmware stopped without a command
        for begin, end, words in seen.drives:
            late = end - left > ENDED_MS + seen.paused_ms
            drove = any(begin <= armed <= left for armed in run.armed)  # and did not only wait for a request
            # None: it was killed, and the next start tells of it.
            if begin <= left < end and drove and late and words is not None:
                return f"stopped at {left} ms, and the drive ended at {end}"
    return None
