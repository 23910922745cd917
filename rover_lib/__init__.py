"""Put a learned driving policy (LeRobot ACT) on a small computer.

Imports go one way: onboard <- workshop <- cli <- what stands beside it <- balloon_world <- lab.
"""

import os

# Before anything loads torch: OpenMP's threads wait by spinning, and so do XNNPACK's, each on the cores that the other
# wants. INT8 on two cores took 124 ms so, and 2.6 ms without (measured on an x86-64 workstation, small policy).
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
