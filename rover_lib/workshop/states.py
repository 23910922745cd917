"""Hold a recorded state against the actions: of these names, a car's state is its last action.

A converter's zeros, the action of the same row or one in other units are in files that are well-formed in every other
way. What learned from them meets another state on the car.
"""

from collections.abc import Sequence

import numpy as np

LAGS = (1, 0, 2, 3, 4, 5, -1, -2)  # rows by which a state may follow the action; 1 is right
LEAST_ROWS = 8
VARIES = 1e-5  # standard deviation, of an action or of the state's mean; less is rounding
NEAR = 0.1  # of the actions' standard deviation: the mean distance of what is the same, but for noise and rounding
NEARER = 1.5  # another lag is the right one if it leaves this much less
ALIKE = 0.98  # correlation with the actions, in other units
FOLLOWS_NONE = "follows no action"
OTHER_STATE = "other_state"  # the kind of fault


def last_actions(actions: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the action before each row, (n, A); 0 where an episode begins. first: (n,) bool."""
    before = np.roll(actions, 1, axis=0)
    before[first] = 0
    return before


def explain_state(states: np.ndarray, actions: np.ndarray, names: Sequence[str]) -> str:
    """Say what an episode's states are, if they are not the action before; empty if they are. Both are (n, A)."""
    names_by_words: dict[str, list[str]] = {}
    if len(states) > LEAST_ROWS and np.isfinite(states).all() and np.isfinite(actions).all():
        states = states.astype(float)
        actions = actions.astype(float)
        for i, name in enumerate(names):
            words = _explain(states[:, i], actions[:, i])
            if words == FOLLOWS_NONE:
                words = _explain_by_any(states[:, i], actions, names)
            if words:
                names_by_words.setdefault(words, []).append(name)
    return ", ".join(f"{' and '.join(names_alike)}: {words}" for words, names_alike in names_by_words.items())


def _explain_by_any(state: np.ndarray, actions: np.ndarray, names: Sequence[str]) -> str:
    """Say which of the actions, (n, A) of these names, a state follows, as when columns are swapped."""
    words = FOLLOWS_NONE
    for name, action in zip(names, actions.T, strict=True):
        follows = _explain(state, action)
        if follows != FOLLOWS_NONE:
            words = f"{follows or _called(1)}, of {name}"
    return words


def _explain(state: np.ndarray, action: np.ndarray) -> str:
    """Say what one number of the state is instead of the action before, or ""."""
    if state.std() <= VARIES * max(1.0, abs(state.mean())):
        same = np.abs(action - state.mean()).max() <= NEAR * max(abs(state.mean()), VARIES)
        return "" if same else f"always {state.mean():.3g}"
    errors = {lag: float(np.abs(np.subtract(*_lagged(state, action, lag))).mean()) for lag in LAGS}
    best = min(LAGS, key=errors.__getitem__)
    if errors[1] <= NEARER * errors[best] + VARIES and errors[1] <= NEAR * max(action.std(), VARIES):
        return ""
    if errors[best] <= NEAR * action.std():
        return _called(best)
    pairs = {lag: _lagged(state, action, lag) for lag in LAGS}
    alike = {lag: abs(np.corrcoef(a, b)[0, 1]) if b.std() > VARIES else 0.0 for lag, (a, b) in pairs.items()}
    best = max(LAGS, key=alike.__getitem__)
    if alike[best] < ALIKE:
        return FOLLOWS_NONE
    gain, offset = np.polyfit(*pairs[best][::-1], 1)
    if best == 1 and abs(gain - 1) < NEAR and abs(offset) < NEAR * state.std():
        return ""  # but for noise
    return f"{gain:.3g} times {_called(best)}" + (f" plus {offset:.3g}" if abs(offset) > NEAR * state.std() else "")


def _lagged(state: np.ndarray, action: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the states of the rows that have one `lag` rows before, and the actions of those."""
    return (state[lag:], action[: len(action) - lag]) if lag >= 0 else (state[:lag], action[-lag:])


def _called(lag: int) -> str:
    if lag == 1:
        return "the last action"
    if lag == 0:
        return "the action of the same row"
    return f"the action {abs(lag)} row{'s' * (abs(lag) > 1)} {'before' if lag > 0 else 'later'}"
