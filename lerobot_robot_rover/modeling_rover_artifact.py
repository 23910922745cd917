"""Make an artifact a LeRobot policy: LeRobot's loop asks the same confined process that `rover drive` uses."""

import logging
import shutil
import weakref
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_robot_rover.configuration_rover_artifact import RoverArtifactConfig, not_trained
from lerobot_robot_rover.line import ACTIONS, wait_for_humans
from lerobot_robot_rover.rollout import find_rollout
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.car.host import boottime
from rover_lib.onboard.drive.drive import another_car
from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.drive.pilot import RECORD_HERE, unfamiliar
from rover_lib.onboard.drive.plan import STOP, WARN, Plan, Settings, Smoother, is_unfamiliar
from rover_lib.onboard.errors import DriveFault, ParamsError, PolicyError
from rover_lib.onboard.params import params

_log = logging.getLogger("rover")


class RoverArtifactPolicy(PreTrainedPolicy):
    """Runs an artifact.

    Raises ParamsError or PolicyError for one that is missing, damaged or made for other actions,
    and for a dataset whose rate is not the artifact's; CarError for one that would steer this car mirrored.
    """

    config_class = RoverArtifactConfig
    name = "rover_artifact"

    def __init__(self, config: RoverArtifactConfig, dataset_meta: Any = None, **kwargs: Any):
        super().__init__(config)
        self.config: RoverArtifactConfig = config
        self._limits = this_car().limits
        self._settings = Settings.of(params()["drive"])
        self._queue: deque[Tensor] = deque()
        self._smoother = Smoother()
        self._warned = False
        self._planned_s = 0.0  # when the queue was filled
        self._plans = 0
        self._process = PolicyProcess(config.file)
        weakref.finalize(self, self._process.close)  # at the program's end too, and if _check() refuses it
        self._process.__enter__()  # returns after the first inferences, which are slow
        self._check(self._process.manifest, dataset_meta)
        if self._process.unconfined:
            _log.warning("the policy's process is not confined: %s", self._process.unconfined)

    def get_optim_params(self, *args: Any) -> Any:
        raise not_trained()

    forward = get_optim_params

    def reset(self) -> None:
        """Prepare for an episode: wait for the human's gesture, which is not part of it, if a rover is connected."""
        self._queue.clear()
        self._smoother = Smoother()
        self._warned = False
        wait_for_humans()

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the chunk's next action, (B, 2) [steering, throttle]; after n_action_steps or stop_s, a new one's.

        Raises as predict_action_chunk().
        """
        if boottime() - self._planned_s > self._settings.stop_s:
            self._queue.clear()
        if not self._queue:
            self._planned_s = boottime()
            chunk = self.predict_action_chunk(batch)[:, : self.config.n_action_steps]
            self._queue.extend(chunk.transpose(0, 1))
        return self._queue.popleft()

    def _check_familiar(self) -> None:
        if self._process.strange is None or not is_unfamiliar(strange := self._smoother.add(self._process.strange)):
            return
        if self._settings.unfamiliar == STOP:
            raise DriveFault(unfamiliar(strange), remedy=RECORD_HERE)
        if self._settings.unfamiliar == WARN and not self._warned:
            self._warned = True
            _log.warning(unfamiliar(strange))

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, chunk, 2) float32 [steering, throttle], clipped as `rover drive` clips it.

        batch: has `observation.images.<camera>`, (B, 3, h, w) float in [0, 1] RGB, and `observation.state`, (B, 2).
        Raises PolicyError if one of them is missing, and for a prediction that is not finite or far out of range;
        DriveFault where the policy has seen nothing like its pictures, unless params.yml has it otherwise.
        """
        camera = f"{OBS_IMAGES}.{self._camera}"
        if not {camera, OBS_STATE} <= set(batch):
            remedy = f"--robot.camera_name={self._camera} --dataset.video=true"
            problem = f"the policy needs {camera} and {OBS_STATE}"
            raise PolicyError(problem, found=sorted(map(str, batch)), remedy=remedy)
        pictures = (batch[camera].detach().cpu() * 255).round().clamp(0, 255).to(torch.uint8)
        states = batch[OBS_STATE].detach().cpu().numpy()
        chunks = []
        for picture, state in zip(pictures.permute(0, 2, 3, 1).numpy(), states, strict=True):
            actions = self._process.predict(np.ascontiguousarray(picture[..., ::-1]), state)
            self._plans += 1
            self._check_familiar()
            chunks.append(Plan(self._plans, 0.0, 0.0, actions, self._limits).actions)
        return torch.from_numpy(np.stack(chunks).astype(np.float32))

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, *, config: Any = None, **kwargs: Any) -> Any:
        """Return the policy in a folder that pack() wrote. Raises ParamsError for anything else, such as a Hub name."""
        if config is not None and pretrained_name_or_path is None:  # lerobot-rollout with --policy.artifact
            return cls(config, **kwargs).eval()
        folder = Path(pretrained_name_or_path)
        if not folder.is_dir():
            raise ParamsError(f"{folder}: not a folder", remedy="`python -m lerobot_robot_rover` packs an artifact")
        config = config or RoverArtifactConfig.from_pretrained(folder)
        config.pretrained_path = folder
        return cls(config, **kwargs).eval()

    def _save_pretrained(self, save_directory: Path, state_dict: Any = None) -> None:
        """Write the artifact and a config that names it."""
        file = self.config.file
        inputs = {OBS_STATE: PolicyFeature(FeatureType.STATE, (2,))}
        for c in self._process.manifest["cameras"]:
            inputs[f"{OBS_IMAGES}.{c['name']}"] = PolicyFeature(FeatureType.VISUAL, (3, c["height"], c["width"]))
        outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (2,))}
        shutil.copyfile(file, save_directory / file.name)
        changes: dict[str, Any] = {"artifact": file.name, "input_features": inputs, "output_features": outputs}
        replace(self.config, **changes)._save_pretrained(save_directory)

    def _check(self, manifest: dict[str, Any], dataset_meta: Any) -> None:
        """Raise PolicyError or ParamsError unless LeRobot's loop can run this artifact as `rover drive` would."""
        cameras = [camera["name"] for camera in manifest["cameras"]]
        names = manifest["state_names"], manifest["action_names"]
        if names != ([*ACTIONS], [*ACTIONS]) or len(cameras) != 1:
            problem = "the rover has one camera, and steering and throttle as state and actions"
            raise PolicyError(problem, found=f"{cameras} and {names}")
        self._camera = cameras[0]
        rate_hz = float(manifest["rate_hz"])
        chunk = int(manifest["chunk"])
        stop_s = self._settings.stop_s
        if self.config.n_action_steps > (limit := min(chunk, int(stop_s * rate_hz))):
            problem = f"n_action_steps may be {limit} at most: `rover drive` stops by a plan of {stop_s:g} s"
            raise ParamsError(problem, found=self.config.n_action_steps)
        if sentence := another_car(manifest, this_car()):
            _log.warning(sentence)
        for asks, option in ((find_rollout(), "--fps"), (dataset_meta, "--dataset.fps")):
            if asks is not None and asks.fps != rate_hz:
                raise PolicyError("not this artifact's rate", found=asks.fps, remedy=f"{option}={rate_hz:g}")
