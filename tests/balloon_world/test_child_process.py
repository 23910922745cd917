"""A process beside this one: talked to, ended, and its last words in the errors. Cars and Arduinos prove the rest."""

import sys

import pytest

from balloon_world.child_process import Child
from rover_lib.onboard.errors import TrainingError

ECHO = "import sys; [print(line.upper(), end='', flush=True) for line in sys.stdin]"


def start(program, **options):
    return Child("the program", sys.executable, "-c", program, error=TrainingError, **options)


def test_a_child_that_talks_ends_with_its_input():
    child = start(ECHO, talks=True)
    child.send_line("hello")
    assert child.read(20) == b"HELLO\n" and child.read(0.01) == b""
    child.close()
    assert child.process.returncode == 0
    with pytest.raises(TrainingError, match="the program was closed; make a new one"):
        child.send_line("hello")


def test_its_last_words_are_in_the_error():
    child = start("import sys; sys.stderr.write('one\\ntwo\\n'); sys.exit(7)", talks=True)
    with pytest.raises(TrainingError, match=r"has ended \(exit status 7\): one \| two; start a new one"):
        child.read(20)
    assert child.errors() == ["one", "two"]
    child.close()
