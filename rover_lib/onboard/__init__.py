"""All that runs on the rover, on torch, numpy, cv2, pyserial, PyYAML and the standard library alone."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rover_lib.onboard.policy.load import Policy, load_policy

__all__ = ["Policy", "load_policy"]


def __getattr__(name: str) -> Any:
    # On first use, because what drives the car must not load torch: the policy runs in a process of its own.
    if name in __all__:
        from rover_lib.onboard.policy import load as policy

        return getattr(policy, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
