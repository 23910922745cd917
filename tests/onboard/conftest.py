"""Fake hosts, one that tells nothing and a Raspberry Pi."""

import stat

import pytest

from rover_lib.onboard.car.host import Host


@pytest.fixture
def bare_host(tmp_path):
    """A host that tells nothing."""
    return Host(sys_root=tmp_path, proc_root=tmp_path, vcgencmd=str(tmp_path / "none"))


@pytest.fixture
def pi_host(tmp_path):
    """A Raspberry Pi's files, and a vcgencmd which says that the Pi has been throttled."""
    zone = tmp_path / "sys/class/thermal/thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "type").write_text("cpu-thermal\n")
    (zone / "temp").write_text("61350\n")
    other = tmp_path / "sys/class/thermal/thermal_zone1"
    other.mkdir()
    (other / "type").write_text("rp1_adc\n")
    (other / "temp").write_text("70000\n")
    for core, khz in enumerate((2400000, 1500000)):
        cpu = tmp_path / f"sys/devices/system/cpu/cpu{core}/cpufreq"
        cpu.mkdir(parents=True)
        (cpu / "scaling_cur_freq").write_text(f"{khz}\n")
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/status").write_text("Name:\tpython\nVmPeak:\t 900000 kB\nVmHWM:\t  400000 kB\n")
    (tmp_path / "proc/stat").write_text(
        "cpu  8 0 0 8 0 0 0 0 0 0\ncpu0 3 0 1 5 1 0 0 0 0 0\ncpu1 4 0 0 2 0 0 0 0 0 0\n"
    )
    command = tmp_path / "vcgencmd"
    answers = "get_throttled) echo throttled=0x50000;; pmic_read_adc) echo '     EXT5V_V volt(24)=5.02000000V';;"
    command.write_text(f"#!/bin/sh\ncase $1 in {answers} esac\n")
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    return Host(sys_root=tmp_path / "sys", proc_root=tmp_path / "proc", vcgencmd=str(command))
