"""How unfamiliar a picture is to a policy: how far its encoder's output lies from that of recorded pictures.

It knows nothing of obstacles. What looks like the recordings to the policy is familiar, and may still be a wall.
"""

from collections.abc import Mapping

import numpy as np

from rover_lib.onboard.errors import ArtifactError

# How far `strange` may differ from that of a parity vector: FP32 by the order of sums, INT8 by flipped roundings
TOLERANCE = {False: 0.02, True: 0.25}
# An artifact's parity pictures must reach this share of each limit: wider ones stop nothing. They reached 0.37 to 0.79
# in ten artifacts of seven policies, four of them of real cars.
LEAST_SHARE = 0.15


class Familiar:
    """What is familiar to a policy, as arrays of float32; D is the embedding's size.

    mean: (D,) of recorded embeddings. directions: (k, D), orthonormal, in which they vary most. spread: (k,) standard
    deviation along each. limits: (2,) the scores from which on a picture is unfamiliar.
    """

    def __init__(self, mean: np.ndarray, directions: np.ndarray, spread: np.ndarray, limits: np.ndarray):
        self.mean = mean
        self.directions = directions
        self.spread = spread
        self.limits = limits

    @classmethod
    def of(cls, vectors: Mapping[str, np.ndarray]) -> "Familiar | None":
        """Return what an artifact's parity vectors say; None if they say nothing of it."""
        names = ("mean", "directions", "spread", "limits")
        return cls(*(vectors[f"familiar_{name}"] for name in names)) if "familiar_mean" in vectors else None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what `of` reads."""
        return {f"familiar_{name}": value for name, value in vars(self).items()}

    def scores(self, embeddings: np.ndarray) -> np.ndarray:
        """Return two scores of each embedding, (n, D) float32 -> (n, 2): they see different things.

        The first is the distance along the directions, in standard deviations (Mahalanobis, as a root mean square); the
        second is the length of what the directions leave over.
        """
        centred = embeddings - self.mean
        along = centred @ self.directions.T
        distances = np.sqrt(((along / self.spread) ** 2).mean(1))
        return np.stack([distances, np.linalg.norm(centred - along @ self.directions, axis=1)], 1)

    def shares(self, embeddings: np.ndarray) -> np.ndarray:
        """Return the scores of each embedding, (n, D) float32 -> (n, 2), as shares of the limits."""
        return self.scores(embeddings) / self.limits

    def check_limits(self, embeddings: np.ndarray, where: object) -> None:
        """Raise ArtifactError if recorded embeddings, (n, D), come nowhere near a limit: it would stop nothing."""
        share = float(self.shares(embeddings).max(0).min())
        if not share >= LEAST_SHARE:
            problem = f"{where}: its limits of the unfamiliar are so wide that they would stop nothing"
            remedy = "leave out a recording that is unlike all others, and quantize again"
            raise ArtifactError(problem, found=f"{share:.2g} of a limit in recorded pictures", remedy=remedy)

    def strange(self, embeddings: np.ndarray) -> np.ndarray:
        """Return how unfamiliar each embedding is, (n, D) float32 -> (n,), as a share of the threshold."""
        return self.shares(embeddings).max(1)
