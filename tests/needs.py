"""What a test needs of the machine: it is skipped, with the reason, where that is not there."""

import pytest

from rover_lib.workshop import arm

QEMU_MISSING = arm.missing_packages()
qemu = pytest.mark.skipif(bool(QEMU_MISSING), reason=f"needs the Debian packages {' '.join(QEMU_MISSING)}")
