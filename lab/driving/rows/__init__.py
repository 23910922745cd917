"""Every fault of a drive, by whose fault it is: one module a kind, and a row is added where its kind is."""

from lab.driving.row import FaultRow
from lab.driving.rows import firmware, host, link, operator, perception, policy, receiver, view

KINDS = {m.FAULTS.kind: m.FAULTS for m in (perception, policy, link, firmware, receiver, host, operator, view)}
FAULTS: list[FaultRow] = [row for kind in KINDS.values() for row in kind.rows]
