"""Rain, snow and fog: haze over the land, and a sky and light to go with it."""

from dataclasses import replace

import numpy as np

from cloning.base.errors import TrackError
from cloning.road.disturbances import Disturbance
from simulator.scenery.looks import tone_matrix
from simulator.scenery.parts import Haze, Scenery
from simulator.scenery.textures import plain

# Haze, and the camera's contrast, saturation and brightness
WEATHERS = {
    "rainy": (Haze((0.50, 0.53, 0.57), (15, 220), 0.95), (0.85, 0.5, -18.0)),
    "snowy": (Haze((0.88, 0.90, 0.93), (8, 150), 0.97), (0.90, 0.4, 14.0)),
    "foggy": (Haze((0.74, 0.76, 0.78), (5, 70), 0.99), (0.95, 0.7, 0.0)),
}
FALLING = {"rainy": Disturbance("rain", 2), "snowy": Disturbance("snow", 2)}  # drops and flakes in the cameras' frames


def in_weather(scenery: Scenery, weather: str) -> Scenery:
    """Return the scenery in a weather: "sunny", which leaves it as it is, or a key of WEATHERS. Raises TrackError."""
    if weather == "sunny":
        return scenery
    if weather not in WEATHERS:
        raise TrackError(f"{weather[:40]}: there is no such weather; there are sunny, {', '.join(WEATHERS)}")
    haze, (contrast, saturation, brightness) = WEATHERS[weather]
    sky = replace(scenery.sky, colours=np.broadcast_to(haze.colour, scenery.sky.points.shape), texture=plain())
    return replace(scenery, sky=sky, haze=haze, tone=tone_matrix(contrast, saturation, np.full(3, brightness)))
