"""Driving by hand: keyboard, mouse and gamepad as in the real simulator's training mode, without the render engine."""

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

from cloning.road.motion import TOP_SPEED_MPH

# Change of steering in each physics step: outwards while a key is held, else back to 0. The original's is 0.05 at any
# speed: full lock in 0.4 s. Here it is half that at 10 mph, a third at 20. A scripted person who looks 6 times a
# second and reacts after 0.35 s leaves the lake's road 27 times in two laps at 20 mph with the original's, and never
# with this. One who also knows what the keys pressed before will do drives the jungle, too; the first one leaves that
# at 20 mph, but not at 15.
KEY_STEP, HALF_SPEED = 0.05, 10.0
RETURN = 3  # times as fast back to 0, once the key is let go
CRUISE_THROTTLE = 0.4
DEAD_ZONE = 0.08  # share of a stick's travel, around its middle, that counts as 0
FULL_DRAG = 0.5  # share of the window's width: dragging the mouse this far gives full steering
HELP = """arrows or WASD   steer, throttle, brake and reverse
mouse drag       steer
space            cruise (throttle 0.4) on or off
+, minus         set speed up or down by 1 mph
R                record on or off
X and Y          save this position, jump back to it
C                chase or bonnet view
F1               show or hide this help
Esc              quit

gamepad (Logitech F310 and similar): left stick throttle,
right stick steering, D pad set speed, A cruise, B record,
X save position, Y jump back"""

KEYS = {  # keys and gamepad buttons by action
    "cruise": ("space", "pad a"),
    "record": ("r", "pad b"),
    "save": ("x", "pad x"),
    "jump": ("y", "pad y"),
    "faster": ("+", "=", "pad up"),
    "slower": ("-", "pad down"),
    "view": ("c",),
    "help": ("f1",),
    "quit": ("escape",),
}
ACTIONS = {key: action for action, keys in KEYS.items() for key in keys}
# Direction -> the keys that are held for it
HELD = {
    "left": ("arrow_left", "a"),
    "right": ("arrow_right", "d"),
    "up": ("arrow_up", "w"),
    "down": ("arrow_down", "s"),
}


@dataclass
class Sticks:
    """A gamepad's sticks, -1..1 with up and right positive, and its pressed buttons: a, b, x, y, up, down."""

    throttle: float = 0.0
    steering: float = 0.0
    buttons: set[str] = field(default_factory=set)


def apply_dead_zone(value: float) -> float:
    """Return a stick's value, -1..1, as 0 within the dead zone and continuous outside it."""
    beyond = max(0.0, abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return min(1.0, beyond) if value > 0 else -min(1.0, beyond)


def balance(held: AbstractSet[str], positive: str, negative: str) -> float:
    """Return 1 if only keys for the direction `positive` are held, -1 if only keys for `negative`, else 0."""
    return float(not held.isdisjoint(HELD[positive])) - float(not held.isdisjoint(HELD[negative]))


class Controls:
    """The person's commands: steering and throttle -1..1, cruise control, set speed in mph, and pending actions."""

    def __init__(self) -> None:
        self.steering = self.throttle = 0.0
        self.cruise, self.set_speed = False, TOP_SPEED_MPH
        self.actions: list[str] = []
        self.buttons: set[str] = set()
        self.device = "keys"  # that steered last: keys, mouse or gamepad
        self.drag: tuple[float, float] | None = None  # mouse position and steering when the drag began

    def press(self, key: str) -> None:
        """Handle a key or gamepad button that was pressed, such as "r", "space" or "pad a"."""
        action = ACTIONS.get(key)
        if action == "cruise":
            self.cruise = not self.cruise
        elif action == "faster":
            self.set_speed = min(TOP_SPEED_MPH, self.set_speed + 1)
        elif action == "slower":
            self.set_speed = max(1, self.set_speed - 1)
        elif action:
            self.actions.append(action)

    def take_actions(self) -> list[str]:
        """Return the actions requested since the last call, out of record, save, jump, view, help and quit."""
        actions, self.actions = self.actions, []
        return actions

    def step(
        self, held: AbstractSet[str], mouse: float | None = None, pad: Sticks | None = None, speed: float = 0.0
    ) -> None:
        """Update the commands for one physics step.

        held: the keys that are down; mouse: its horizontal position, -1..1, while its button is down; speed: mph.
        """
        for button in sorted(pad.buttons - self.buttons) if pad else ():
            self.press(f"pad {button}")
        self.buttons = set(pad.buttons) if pad else set()
        stick = apply_dead_zone(pad.steering) if pad else 0.0
        if mouse is not None:
            if self.drag is None:
                self.drag = mouse, self.steering
            start, before = self.drag
            self.steering, self.device = max(-1.0, min(1.0, before + (mouse - start) / 2 / FULL_DRAG)), "mouse"
        elif stick:
            self.steering, self.device = stick, "gamepad"
        else:
            wanted, outwards = balance(held, "right", "left"), KEY_STEP / (1 + speed / HALF_SPEED)
            step = outwards if wanted * self.steering >= 0 and wanted else min(KEY_STEP, RETURN * outwards)
            self.steering += max(-step, min(step, wanted - self.steering))
            self.device = "keys" if wanted else self.device
        if mouse is None:
            self.drag = None
        pedal = balance(held, "up", "down")
        push = apply_dead_zone(pad.throttle) if pad else 0.0
        if pedal < 0 or push < 0:
            self.cruise = False
        self.throttle = pedal or push or (CRUISE_THROTTLE if self.cruise else 0.0)
