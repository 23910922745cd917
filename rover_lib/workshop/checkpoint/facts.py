"""What is known of a policy, and by whom: each fact once, with its source, from all files that are there.

facts = Facts(path, said)              # what the user says by --facts
facts.say("rate", 15.0, "config.fps")  # CheckpointError, if another source contradicts it
facts.read(content, "config.")         # keys that nobody here knows, by the words of their names in keys.yml
"""

import re
import shlex
from collections.abc import Iterator, Mapping
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from torch import Tensor

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD
from rover_lib.onboard.recording.episode import CHANNELS
from rover_lib.workshop.recordings.names import flat_names, read_as_car
from rover_lib.workshop.untrusted import quote, quote_all

USER, GUESS = "--facts", "a guess"
WORDS = yaml.safe_load(Path(__file__).with_name("keys.yml").read_text())
NETWORK = 10_000  # floats; more may be all weights of a network
SMALL = 64  # numbers or keys; more are weights
DRIVES = "which may be the weights that should drive"
# Values that change nothing, unlike True.
NOTHING: tuple[Any, ...] = (None, False, 0, 1, "", "none", "identity", "rgb", "relu", "sine", "jpg", "png", [], (), {})


class Facts:
    """The facts of the policy at `path`: {fact: (value, who says it)}, notes, and keys whose meaning is unknown.

    Of such a key that changes nothing, as its value or its name says, the value is None.
    """

    def __init__(self, path: Path, said: str = ""):
        """said: what the user says, such as "rate=20 actions=throttle,steering size=64x48 ignore=KEY,KEY"."""
        self.path = path
        self.notes: list[str] = []
        self.known: dict[str, tuple[Any, str]] = {}
        self.unknown: dict[str, Any] = {}
        try:
            overrides = dict(part.split("=", 1) for part in said.split())
            self.ignored = {*overrides.pop("ignore", "").split(",")}
            for fact, text in overrides.items():
                parts = re.split("[x,]", text)
                value: Any = tuple(parts) if fact == "actions" else float(parts[0])
                self.say(fact, (int(parts[1]), int(parts[0])) if fact == "size" else value, USER)
            if overrides.keys() - {"rate", "actions", "size"}:
                raise ValueError
        except (ValueError, IndexError):
            remedy = f'as in {USER} "rate=20 actions=throttle,steering size=64x48 ignore=KEY"'
            raise CheckpointError(f"{USER} {quote(said)} is not understood", remedy=remedy) from None

    def value(self, fact: str) -> Any:
        return self.known.get(fact, (None, ""))[0]

    def source(self, fact: str) -> str:
        return self.known.get(fact, (None, GUESS))[1]

    def default(self, fact: str, value: Any, source: str) -> Any:
        """Return what is known of a fact, or `value`, which is then known by `source`."""
        return self.known.setdefault(fact, (value, source))[0]

    def say(self, fact: str, value: Any, source: str) -> None:
        """Add a fact. Raises CheckpointError if another source contradicts it, and the user ignores neither."""
        if source in self.ignored:
            return
        earlier, by = self.known.setdefault(fact, (value, source))
        if not _same(earlier, value):
            origins = [shlex.quote(f"ignore={origin}") for origin in (source, by) if origin != USER]
            options = " or ".join(f"{USER} {origin}" for origin in origins)
            problem = f"{self.path}: {by} and {source} contradict each other on its {fact}"
            actual = f"{quote(str(earlier))} and {quote(str(value))}"
            raise CheckpointError(problem, found=actual, remedy=f"pass {options}")

    def compare(self, fact: str, said: Mapping[str, Any]) -> None:
        """Raise CheckpointError, as `say` does, if two of {source: value} contradict each other. Nothing is kept."""
        for source, value in said.items():
            self.say(fact, value, source)
        self.known.pop(fact, None)

    def read(self, content: Mapping[str, Any], where: str, noted: bool = True) -> None:
        """Read keys that nobody here knows. where: what stands before their names. noted: whether to name the rest.

        Raises CheckpointError for a key that may change the actions, where it is not plain how.
        """
        refused = dict[_Key, str]()
        for key in starmap(_Key, _flatten(content, where)):
            if key.name in self.ignored or (not key.harmless and self._read_key(key)):
                continue
            why = "" if key.harmless else key.changes()
            if noted and not (why or key.harmless):
                why = key.unclear(self.value("chunk"))
            if why:
                refused[key] = why
            elif noted:
                self.unknown[key.name] = None if key.harmless else key.value
        if refused:
            key, why = next(iter(refused.items()))
            value = f"{len(key.value)} values" if key.of_network or isinstance(key.value, Mapping) else key.value
            raise self.refusal(key.name, value, why, ",".join(other.name for other in refused))

    def refusal(self, key: str, value: Any, why: str, ignored: str = "") -> CheckpointError:
        """Return the error of a key that cannot be used, for the caller to raise. ignored: all such keys."""
        option = shlex.quote(f"ignore={ignored or key}")
        remedy = f"save the policy without it, or if it changes no action, pass {USER} {option}"
        return CheckpointError(f"{self.path}: '{key}' is {quote(str(value))}, {why}", remedy=remedy)

    def _read_key(self, key: "_Key") -> bool:
        """Read a key whose name and value plainly say a fact; False for others."""
        name = key.name
        value = key.value
        named = value
        if isinstance(value, str) and key.has("order"):
            named = [word for word in re.findall("[a-z]+", value.lower()) if word in CHANNELS]
        names = flat_names(named)
        meant = read_as_car(flat_names(named))
        if len(names) > 1 and key.has("states"):
            if meant != names:
                raise self.refusal(name, value, f"{quote_all(names)}, and here the state is the last action")
            self.say("state", names, name)
        elif len(names) > 1 and (meant or key.words & {"action", "actions"}):
            if meant and meant != names and self.value("actions") is None:
                problem = f"{self.path}: '{name}' is {quote_all(names)}: are they steering and throttle?"
                raise CheckpointError(problem, remedy=f"if they are, pass {USER} actions={','.join(meant)}")
            self.say("actions", meant or names, name)
        elif (key.has("rate") or "rate" in key.last <= {*WORDS["of_rate"]}) and is_number(value, 1, 1000):
            self.say("rate", float(value), name)
        elif "timestamps" in key.words and len(value) > 1:
            self.say("rate", round(float(1 / np.diff(value).mean()), 3), name)
        elif self.value("size") and key.words & {*WORDS["image"]} and key.has("size"):
            height, width = self.value("size")
            if not {*map(int, re.findall("[0-9]+", str(value)))} <= {1, 3, height, width}:
                raise self.refusal(name, value, f"and its pictures are {width}x{height}: pass {USER} size=WxH")
        else:
            return False
        return True


class _Key:
    """A key that nobody here knows. words: of its name and of a text as its value; last: of its name's last part."""

    def __init__(self, name: str, value: Any):
        self.name = name
        self.value = value
        self.last = words_of(re.split("[.:]", name)[-1])
        self.words = words_of(name) | (words_of(value) if isinstance(value, str) else set())  # action_type: delta
        self.several = isinstance(value, (list, tuple)) and len(value) > 1
        self.is_label = self.has("labels") and not self.several  # the name of a run may have any words
        self.of_network = count_floats(value) >= NETWORK
        done = any(self.last >= {*words} for words in WORDS["done"])
        self.done = done or (self.has("image") and "normali" in name)  # always, here

    def has(self, kind: str) -> bool:
        """Whether the last part of its name has one of keys.yml's words of this kind."""
        return not self.last.isdisjoint(WORDS[kind])

    @property
    def harmless(self) -> bool:
        """Whether it changes no action, by its value or because it is of training."""
        if self.done and isinstance(self.value, bool):
            return self.value
        of_training = self.has("training") or not self.words.isdisjoint(WORDS["augments"])
        if self.of_network and self.has("weights") and self.words.isdisjoint(WORDS["optimizer"]):
            return False
        usual = any(_same(self.value, own) for own in (IMAGENET_MEAN, IMAGENET_STD))
        return (self.value is not True and self.value in NOTHING) or of_training or usual

    def changes(self) -> str:
        """Say what it may change by the words of its name, or "" if they say nothing of the kind."""
        words = words_of(self.name) if self.is_label else self.words
        meaning = next((meaning for meaning, verbs in WORDS["changes"].items() if words & {*verbs}), "")
        one_for_each = self.several and len(self.value) == 2
        of_numbers = self.value is True or one_for_each or words & {*WORDS["numbers"]}
        plain = meaning and (of_numbers or not {"units", "actions"} & words_of(meaning))
        return f"which may mean {meaning}" if plain else ""

    def unclear(self, chunk: Any) -> str:
        """Say why it cannot be passed over though its words say nothing, or "". chunk: steps of a plan."""
        if self.done and self.value is False:
            return "and here that is always done"
        if self.of_network or (
            isinstance(self.value, Mapping) and any(isinstance(v, Tensor) for v in self.value.values())
        ):
            return DRIVES
        relevant = self.has("image") or self.has("numbers") or (self.several and self.last & {"camera", "cameras"})
        if relevant and not self.is_label and self.value not in (2, 3, chunk):  # counts that it has
            return "and nobody here knows what that does to its numbers or pictures"
        return ""


def words_of(key: str) -> set[str]:
    """Return the words of a key's name: those of `actionMean` are action and mean."""
    return set(re.findall("[a-z]+[0-9]*", re.sub("([a-z])([A-Z])", r"\1_\2", key).lower()))


def meaning_of(name: str) -> str:
    """Say what a file beside the weights, or a weight that no ACT has, may mean by its name; "" if unknown."""
    words = words_of(name)
    if not words.isdisjoint(WORDS["averaged"]):
        return DRIVES
    if not words.isdisjoint(WORDS["statistics"]) or len(words & {*WORDS["ends"]}) > 1:
        return "which may mean how its numbers are normalised"
    return ""


def count_floats(value: Any) -> int:
    """Return how many numbers all tensors of floats in nested dicts, lists and tuples have."""
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return sum(map(count_floats, value))
    return value.numel() if isinstance(value, Tensor) and value.is_floating_point() else 0


def _same(a: Any, b: Any) -> bool:
    try:
        return bool(np.allclose(np.asarray(a, float), np.asarray(b, float), rtol=1e-4, atol=1e-6, equal_nan=True))
    except (TypeError, ValueError):  # words, or another number of numbers
        return bool(a == b)


def _flatten(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Yield ("action_stats.mean", [0.0, 0.4]): dicts opened unless they number names, small tensors as lists."""
    if isinstance(value, (Tensor, np.ndarray, np.generic)) and count_floats(value) < NETWORK:
        count = value.numel() if isinstance(value, Tensor) else value.size
        value = value.tolist() if count <= SMALL else f"{count} numbers"
    numbered = isinstance(value, Mapping) and read_as_car(tuple(value)) and all(map(is_number, value.values()))
    if not isinstance(value, Mapping) or len(value) > SMALL or numbered:
        yield key, value
        return
    for name, inner in value.items():
        yield from _flatten(inner, f"{key}{name}" if not key or key[-1] in ".:" else f"{key}.{name}")
