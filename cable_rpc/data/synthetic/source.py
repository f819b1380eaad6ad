"""The rendered world as a source of frames."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from urllib.parse import urlencode

from cable_rpc.data.synthetic.camera import Camera
from cable_rpc.data.synthetic.route import ROUTES, STREETS_ROUTE, TRAFFICS
from cable_rpc.data.synthetic.world import World
from cable_rpc.errors import ConfigurationError
from cable_rpc.types import CameraMount, Frame


@dataclass(frozen=True)
class SyntheticConfig:
    """What to render; the seed chooses street, weather, traffic and everything else."""

    seed: int = 0
    width: int = 960
    height: int = 540
    fps: float = 10.0
    frame_count: int = 120
    horizontal_fov_deg: float = 68.0
    mount_height_m: float = 1.45
    pitch_down_deg: float = 1.8
    noise_strength: float = 1.6
    """Standard deviation of the sensor noise at mid grey, in grey levels."""
    blur_sigma: float = 0.55
    """Lens blur in pixels."""
    vignette: float = 0.28
    """Loss of light in the corners, 0..1."""
    route: str = STREETS_ROUTE.name
    """`streets`; `turns`: one tight corner after the other; `straight`; `standstill`: waiting at a red light."""
    traffic: str = "normal"
    """`none` is the same drive through the same streets with nobody in sight."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigurationError(f"SyntheticConfig.seed is {self.seed}; use 0 or more")
        if self.width < 32 or self.height < 32:
            raise ConfigurationError(f"SyntheticConfig is {self.width}x{self.height} pixels; use at least 32x32")
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise ConfigurationError(f"SyntheticConfig.fps is {self.fps}; use a finite rate above 0")
        if self.frame_count < 1:
            raise ConfigurationError(f"SyntheticConfig.frame_count is {self.frame_count}; use 1 or more")
        if not 20.0 <= self.horizontal_fov_deg <= 120.0:
            raise ConfigurationError(f"SyntheticConfig.horizontal_fov_deg is {self.horizontal_fov_deg}; use 20..120")
        if self.route not in ROUTES:
            raise ConfigurationError(f"SyntheticConfig.route is '{self.route}'; known are {', '.join(ROUTES)}")
        if self.traffic not in TRAFFICS:
            raise ConfigurationError(f"SyntheticConfig.traffic is '{self.traffic}'; known are {', '.join(TRAFFICS)}")

    @property
    def name(self) -> str:
        """The source spec of this world: ``synthetic:SEED``, and its route and traffic where not the defaults."""
        chosen = {"route": self.route, "traffic": self.traffic}
        usual = {"route": STREETS_ROUTE.name, "traffic": "normal"}
        options = urlencode({key: value for key, value in chosen.items() if value != usual[key]})
        return f"synthetic:{self.seed}" + (f"?{options}" if options else "")


class SyntheticSource:
    """An endless supply of exact truth: iterates rendered frames, and renders any frame by index.

    Frame ``i`` depends only on the configuration and ``i``, never on the order of access.
    """

    def __init__(self, config: SyntheticConfig) -> None:
        self.config = config
        self.name = config.name
        self.fps = config.fps
        self.size_wh = (config.width, config.height)
        self.frame_count = config.frame_count
        self.camera = Camera.with_field_of_view(
            config.width,
            config.height,
            config.horizontal_fov_deg,
            config.mount_height_m,
            math.radians(config.pitch_down_deg),
        )
        duration_s = (config.frame_count - 1) / config.fps + 0.5
        self.intrinsics = self.camera.intrinsics
        self.mount = CameraMount(config.mount_height_m, math.radians(config.pitch_down_deg))
        self.world = World(
            config.seed,
            self.camera,
            duration_s,
            ROUTES[config.route],
            config.traffic != "none",
            config.noise_strength,
            config.blur_sigma,
            config.vignette,
        )

    def __len__(self) -> int:
        return self.frame_count

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in range(self.frame_count))

    def frame(self, index: int) -> Frame:
        """Render one frame.

        Args:
            index: 0 .. frame_count - 1.

        Returns:
            The frame with ego-motion, intrinsics and full truth.

        Raises:
            IndexError: The index is outside the clip.
        """
        if not 0 <= index < self.frame_count:
            raise IndexError(f"{self.name} has frames 0..{self.frame_count - 1}, not {index}")
        time_s = index / self.fps
        image, truth = self.world.render(time_s, index)
        return Frame(
            image,
            index,
            round(index * 1e9 / self.fps),
            self.world.ego(time_s)[1],
            self.camera.intrinsics,
            truth,
            self.mount,
        )
