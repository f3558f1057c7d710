"""How a person drives: keyboard, mouse and gamepad, as in the original recorder; knows no engine."""

from dataclasses import dataclass, field

KEY_STEP = 0.05  # of steering a physics step while a key is held, and back again
CRUISE_THROTTLE = 0.4
DEAD_ZONE = 0.08  # of a stick around its middle
DRAG = 0.5  # of the window's width that the mouse is dragged for full steering
TOP_MPH = 30
HELP = """arrows or WASD   steer, throttle, brake and reverse
mouse drag       steer
space            cruise (throttle 0.4) on or off
+ and -          set speed up or down by 1 mph
R                record on or off
X and Y          save this position, jump back to it
C                chase or bonnet view
F1               these keys
Esc              quit

gamepad (Logitech F310 and the like): left stick throttle,
right stick steering, D-pad set speed, A cruise, B record,
X save position, Y jump back"""

# What a key press or a gamepad button does
ACTIONS = {
    "space": "cruise",
    "pad a": "cruise",
    "r": "record",
    "pad b": "record",
    "x": "save",
    "pad x": "save",
    "y": "jump",
    "pad y": "jump",
    "+": "faster",
    "=": "faster",
    "pad up": "faster",
    "-": "slower",
    "pad down": "slower",
    "c": "view",
    "f1": "help",
    "escape": "quit",
}
HELD = {
    "left": ("arrow_left", "a"),
    "right": ("arrow_right", "d"),
    "up": ("arrow_up", "w"),
    "down": ("arrow_down", "s"),
}


@dataclass
class Sticks:
    """A gamepad's sticks, -1..1 with up and right positive, and the buttons held: a, b, x, y, up, down."""

    throttle: float = 0.0
    steering: float = 0.0
    buttons: set = field(default_factory=set)


def past_dead_zone(value: float) -> float:
    """A stick's value, -1..1, without the jitter around its middle and continuous beyond it."""
    beyond = max(0.0, abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return min(1.0, beyond) if value > 0 else -min(1.0, beyond)


class Controls:
    """What the person wants: steering and throttle -1..1, cruise, set speed in mph, and the actions just
    asked for."""

    def __init__(self):
        self.steering = self.throttle = 0.0
        self.cruise, self.set_speed = False, TOP_MPH
        self.asked: list[str] = []
        self.buttons: set = set()
        self.drag: tuple[float, float] | None = None  # the mouse's place and the steering when the drag began

    def press(self, key: str) -> None:
        """A key or gamepad button went down: "r", "space", "pad a"."""
        action = ACTIONS.get(key)
        if action == "cruise":
            self.cruise = not self.cruise
        elif action == "faster":
            self.set_speed = min(TOP_MPH, self.set_speed + 1)
        elif action == "slower":
            self.set_speed = max(1, self.set_speed - 1)
        elif action:
            self.asked.append(action)

    def take(self) -> list[str]:
        """The actions asked for since the last time: record, save, jump, view, help, quit."""
        asked, self.asked = self.asked, []
        return asked

    def pedals(self, held: set) -> float:
        """1 for W, -1 for S, 0 for neither or both."""
        return float(bool(held & set(HELD["up"]))) - float(bool(held & set(HELD["down"])))

    def step(self, held: set, mouse: float | None = None, pad: Sticks | None = None) -> None:
        """One physics step with these keys held; mouse: across the window, -1..1, while its button is
        down."""
        for button in sorted(pad.buttons - self.buttons) if pad else ():
            self.press(f"pad {button}")
        self.buttons = set(pad.buttons) if pad else set()
        keys = float(bool(held & set(HELD["right"]))) - float(bool(held & set(HELD["left"])))
        stick = past_dead_zone(pad.steering) if pad else 0.0
        if mouse is not None:
            if self.drag is None:
                self.drag = mouse, self.steering
            start, before = self.drag
            self.steering = max(-1.0, min(1.0, before + (mouse - start) / 2 / DRAG))
        elif stick:
            self.steering = stick
        else:
            self.steering += max(-KEY_STEP, min(KEY_STEP, keys - self.steering))
        if mouse is None:
            self.drag = None
        pedal = self.pedals(held)
        push = past_dead_zone(pad.throttle) if pad else 0.0
        if pedal < 0 or push < 0:
            self.cruise = False
        self.throttle = pedal or push or (CRUISE_THROTTLE if self.cruise else 0.0)
