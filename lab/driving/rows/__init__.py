"""All faults of a drive, in a module for each kind: whatever is at fault. Add a row to the module of its kind."""

from lab.driving.pins import CAR
from lab.driving.row import FaultRow
from lab.driving.rows import firmware, host, link, operator, perception, policy, receiver, view

KINDS = {m.FAULTS.kind: m.FAULTS for m in (perception, policy, link, firmware, receiver, host, operator, view)}
FAULTS: list[FaultRow] = [row for kind in KINDS.values() for row in kind.rows if row.human in ("", CAR.human)]
