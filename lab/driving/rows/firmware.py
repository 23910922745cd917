"""Faults of the Arduino itself: it is reset, loses its power, or hangs."""

from lab.driving.bench import DrivingBench
from lab.driving.pins import STOPPED
from lab.driving.row import FaultKind

FAULTS = FaultKind("firmware")


@FAULTS.add("Arduino reset", STOPPED, r"was reset \(reset pin\)", "the reset button")
def _reset(bench: DrivingBench) -> None:
    bench.arduino.reset()


@FAULTS.add("Arduino's power cut", STOPPED, r"was reset \(power-on\)", "off and on; the EEPROM is all that stays")
def _cut_power(bench: DrivingBench) -> None:
    bench.arduino.power()


@FAULTS.add("Arduino loop hung", STOPPED, r"was reset \(watchdog\)", "an endless loop in place of the firmware's")
def _hang(bench: DrivingBench) -> None:
    bench.arduino.hang()
