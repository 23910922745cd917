"""Which serial port is the Arduino's, where nobody says it."""

from pathlib import Path

from rover_lib.onboard.errors import RoverError

DEV = Path("/dev")
PROVISIONED = "rover-arduino"  # the name that provisioning gives it
KINDS = ("ttyACM*", "ttyUSB*")


def list_ports(dev: Path = DEV) -> dict[Path, str]:
    """Return each USB serial port, with its name in serial/by-id ("" where it has none)."""
    names = {link.resolve(): link.name for link in sorted((dev / "serial" / "by-id").glob("*"))}
    return {port: names.get(port.resolve(), "") for kind in KINDS for port in sorted(dev.glob(kind))}


def other_ports(port: str, dev: Path = DEV) -> str:
    """Say which other USB serial ports there are, "" if none: udev gives two that are alike the Arduino's one name."""
    own = Path(port).resolve()
    ports = [f"{path} ({name})" if name else str(path) for path, name in list_ports(dev).items()]
    ports = [text for text in ports if text.split()[0] != str(own)]
    return f"{own} was asked, and there is also {', '.join(ports)}: unplug it, or try --port" if ports else ""


def find_port(dev: Path = DEV) -> str:
    """Return the port of the only Arduino: the provisioned name, else the only USB serial port.

    Raises RoverError if there is none, or several, which it lists.
    """
    if (dev / PROVISIONED).exists():
        return str(dev / PROVISIONED)
    ports = list_ports(dev)
    if len(ports) == 1:
        return str(next(iter(ports)))
    names = ", ".join(f"{port} ({name})" if name else str(port) for port, name in ports.items())
    if not ports:
        raise RoverError("no Arduino is plugged in", remedy="plug it in; dmesg | tail says what the kernel saw")
    raise RoverError("which port is the Arduino's?", found=names, remedy=f"pass it: --port {next(iter(ports))}")
