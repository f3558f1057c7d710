"""The driver's controls against the original's, with a fake gamepad, and the window with real key presses."""

import copy
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from commands import HERE, ROOT
from drive_process import awaited
from panda3d.core import GamepadButton, InputDevice

from cloning.base.errors import RecordingError
from cloning.road.motion import FULL_LOCK, MPH, WHEELBASE
from cloning.road.track import Track
from simulator.controls import Controls, Sticks
from simulator.run import Run
from simulator.window import STRAIGHT, Gamepad, Window


def test_at_rest_keys_steer_a_twentieth_a_step_and_let_go_as_fast():
    controls = Controls()
    for n in range(1, 6):
        controls.step({"d"})
        assert controls.steering == pytest.approx(0.05 * n)
    for _ in range(100):
        controls.step({"arrow_left"})
    assert controls.steering == -1
    for _ in range(20):
        controls.step(set())
    assert controls.steering == pytest.approx(0)


REACTION, LOOK = 17, 8  # steps of 0.02 s: 0.34 s until a key follows what is seen, and a look six times a second


def simple(controls: Controls, _: list[set[str]], wanted: float, __: float) -> set[str]:
    """The keys of a person who looks at where the wheels are now, and lets go if they are turned too far."""
    back = abs(wanted) < abs(controls.steering) and wanted * controls.steering >= 0
    more = wanted - controls.steering
    return {"w"} if back or abs(more) < 0.06 else {"w", "d" if more > 0 else "a"}


def anticipating(controls: Controls, pressed: list[set[str]], wanted: float, speed: float) -> set[str]:
    """The keys of a person who knows what the keys pressed before will do, and holds a bend by tapping."""
    after = copy.copy(controls)
    for held in pressed:
        after.step(held, speed=speed)

    def miss(key: str) -> float:
        soon, turned = copy.copy(after), 0.0
        for _ in range(LOOK):
            soon.step({"w", key}, speed=speed)
            turned += soon.steering / LOOK
        return abs(turned - wanted)

    return {"w", min("wad", key=miss)}


@pytest.mark.parametrize(("track", "seconds", "person"), [("lake", 0.9, simple), ("jungle", 1.1, anticipating)])
def test_a_person_with_keys_alone_drives_a_lap_at_20_mph(track, seconds, person):
    """A scripted person of moderate reaction, who looks so far ahead and presses left, right or nothing."""
    run, controls, held, pressed = Run(Track(track)), Controls(), {"w"}, [{"w"}] * REACTION
    run.s = run.track.straight(STRAIGHT)
    run.set_back()
    run.car.speed_limit = 20 * MPH
    for step in range(10_000):
        if step % LOOK == 0:
            position, ahead = run.car.node.get_pos(), 2 + seconds * run.car.speed
            goal = run.track.at((run.s + ahead) % run.track.length)
            bearing = run.car.heading - math.atan2(goal.y - position.y, goal.x - position.x)
            wanted = math.degrees(math.atan(2 * WHEELBASE * math.sin(bearing) / ahead)) / FULL_LOCK
            held = person(controls, pressed, wanted, run.speed_mph)
        pressed.append(held)
        controls.step(pressed.pop(0), speed=run.speed_mph)
        run.step(controls.steering, controls.throttle)
        if run.laps:
            break
    assert run.laps and not run.departures


def test_a_person_starts_on_a_straight():
    for name in ("lake", "jungle", "road-1"):
        run = Run(Track(name))
        run.s = run.track.straight(STRAIGHT)
        run.set_back()
        while run.travelled < STRAIGHT:
            assert run.advance(0.0, 0.4), "W alone leaves the road"


def test_keys_throttle_and_brake_and_cruise_holds_the_throttle_until_the_brake():
    controls = Controls()
    for held, throttle in (("w", 1), ("arrow_up", 1), ("s", -1), ("arrow_down", -1), ("ws", 0), ("", 0)):
        controls.step({held} if "arrow" in held else set(held))
        assert controls.throttle == throttle
    controls.press("space")
    for key, push in (("", 0.4), ("w", 1), ("", 0.4), ("s", -1), ("", 0)):
        controls.step(set(key))
        assert controls.throttle == push


def test_the_mouse_steers_by_how_far_it_is_dragged():
    controls = Controls()
    for mouse, steering in ((0.2, 0.0), (0.7, 0.5), (-1.0, -1.0), (None, -0.95)):
        controls.step(set(), mouse=mouse)
        assert controls.steering == pytest.approx(steering)


class Device:
    """A Logitech F310 as panda3d presents it: axes and buttons by name."""

    def __init__(self):
        axes = InputDevice.Axis
        self.axes = {axes.left_x: 0.9, axes.left_y: 0.0, axes.right_x: 0.0, axes.right_y: -0.9}
        self.down = set()

    def poll(self):
        pass

    def find_axis(self, axis):
        return SimpleNamespace(value=self.axes[axis])

    def find_button(self, handle):
        return SimpleNamespace(pressed=handle in self.down)


def pad_of(*devices):
    manager: Any = SimpleNamespace(
        update=lambda: None, get_devices=lambda wanted: devices if wanted == InputDevice.DeviceClass.gamepad else None
    )
    return Gamepad(manager)


def press(controls, pad, device, *buttons, steps=1):
    """Hold each button for so many steps, one after another."""
    for button in buttons:
        for down in [{button}] * steps + [set()]:
            device.down = down
            controls.step(set(), pad=pad.read())


def test_the_f310s_sticks_and_none():
    assert pad_of().read() is None
    device, controls = Device(), Controls()
    pad = pad_of(device)
    controls.step(set(), pad=pad.read())
    assert (controls.steering, controls.throttle) == (0, 0)  # the other axes drive nothing
    device.axes |= {InputDevice.Axis.left_y: 1.0, InputDevice.Axis.right_x: -1.0}
    controls.step(set(), pad=pad.read())
    assert (controls.steering, controls.throttle) == (-1, 1)
    device.axes[InputDevice.Axis.right_x] = 0.05  # a stick that does not quite come back
    for _ in range(25):
        controls.step(set(), pad=pad.read())
    assert controls.steering == pytest.approx(0)
    controls.step(set(), pad=Sticks(throttle=-0.5, steering=0.5))
    assert controls.throttle < -0.4 and controls.steering > 0.4


def test_the_f310s_buttons_act_once_a_press():
    device, controls = Device(), Controls()
    pad = pad_of(device)
    for button, action in (("face_x", "save"), ("face_y", "jump"), ("face_b", "record")):
        press(controls, pad, device, *[getattr(GamepadButton, button)()] * 2, steps=5)
        assert controls.take_actions() == [action] * 2
    press(controls, pad, device, *[GamepadButton.dpad_down()] * 6, *[GamepadButton.dpad_up()] * 2)
    assert controls.set_speed == 30 - 6 + 2
    press(controls, pad, device, GamepadButton.face_a(), *[GamepadButton.dpad_up()] * 40)
    assert (controls.set_speed, controls.throttle) == (30, 0.4)


def python(*words, env, cwd=ROOT):
    """This Python; not a warm one, whose panda3d knows only the screen that was named when it was loaded."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=cwd, env={**os.environ, **env}, capture_output=True, text=True, timeout=60)


@pytest.fixture
def screen():
    """The environment of programs that use a screen of their own."""
    if not (shutil.which("Xvfb") and shutil.which("xdotool")):
        pytest.skip("needs Xvfb and xdotool")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x640x24"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        yield {**os.environ, "DISPLAY": ":" + os.read(read, 16).decode().strip()}
    finally:
        server.kill()
        server.wait()


LOOK_AT_WINDOW = """
from panda3d import core
from cloning.road.disturbances import Disturbance
from cloning.road.track import Track
from simulator.window import Window, corner_texture
window = Window(Track("lake"), "recorded", disturbance=Disturbance("fog", 4))
window.finish()
for size in ((960, 540), (960, 600), (1000, 312), (500, 620)):
    properties = core.WindowProperties.size(*size)
    window.win.request_properties(properties)
    window.tell("too slow for the picture " * 4)
    for _ in range(3):
        window.task_mgr.step()
    window.act("help")
    width = max(1, window.get_aspect_ratio())
    for text in (window.text, window.help, window.message):
        low, high = text.get_tight_bounds(window.aspect2d)
        assert -width <= low.x < high.x <= width, (size, low, high)
    window.act("help")
    for wheel in window.scene.wheels:
        low, high = wheel.get_tight_bounds(window.cam)
        assert window.camLens.project(core.Point3(low.x, low.y, low.z), core.Point2()), (size, "a wheel is cut off")
assert window.win.get_x_size() == 500
assert "fog:4" in window.text.getText()
shown, seen = window.corner.get_texture(), corner_texture(window.seen.last[0])
assert bytes(shown.get_ram_image()) == bytes(seen.get_ram_image()) and window.seen.last.std() < 30, "fog in the corner"
window.started = True
window.simulation.set_back(4.5)
window.task_mgr.step()
window.simulation.step(0, 0)
window.task_mgr.step()
assert "left the road on the right" in window.message.getText()
assert window.dot.is_hidden() and window.scene.brake_lights.is_hidden()
window.simulation.step(0.5, -1)
window.show(True)
assert not window.scene.brake_lights.is_hidden()
assert {round(wheel.get_h(), 1) for wheel in window.scene.wheels} == {-12.5, 0}, "half of 25 degrees, to the right"
before = window.scene.wheels[0].get_p()
window.simulation.distance += 0.1
window.show(True)
assert window.scene.wheels[0].get_p() != before, "they roll"
window.act("record")
window.task_mgr.step()
assert not window.dot.is_hidden()
window.finish()
"""


def test_the_window_tells_of_a_departure_and_of_recording_and_fits_every_shape(screen, tmp_path):
    done = python("-c", LOOK_AT_WINDOW, cwd=tmp_path, env={**screen, **HERE})
    assert done.returncode == 0, done.stderr
    assert "No definition" not in done.stderr, "the font has every letter of the help"


@pytest.mark.parametrize("drives, status", [(True, 0), (False, 130)])
def test_the_window_is_driven_and_records(screen, tmp_path, drives, status):
    """R, and Ctrl-C before the car has driven, leave no recording."""
    folder = tmp_path / "driven"
    command = [sys.executable, "-m", "simulator", "window", "--folder", str(folder)]
    window = subprocess.Popen(command, env=screen, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    log = folder / "driving_log.csv"

    def xdotool(*arguments):
        subprocess.run(["xdotool", *arguments], env=screen, check=True, stdout=subprocess.DEVNULL)

    def recording(shown):
        """Press R, since the first presses may come before the window listens, and a late one ends the recording."""
        xdotool("key", "r")
        end = time.monotonic() + 3
        while not shown() and time.monotonic() < end:
            time.sleep(0.05)
        return shown()

    def row():
        rows = log.read_text(encoding="utf-8").splitlines()
        return [float(value) for value in rows[-1].split(",")[3:]] if rows else [0, 0, 0, 0]

    def is_driven():
        return row()[0] > 0.1 and row()[1] == 1 and row()[3] > 0.1

    try:
        xdotool("search", "--sync", "--name", "lake ccw")
        awaited(lambda: recording(log.exists))
        if drives:
            xdotool("keydown", "w", "keydown", "d")
            with suppress(AssertionError):
                awaited(is_driven, 10)
            awaited(lambda: is_driven() or recording(is_driven))
            xdotool("keyup", "w", "keyup", "d")
        if status:
            window.send_signal(signal.SIGINT)
        else:
            xdotool("key", "Escape")
        errors = window.communicate(timeout=20)[1]
        assert (window.returncode, "Traceback" in errors) == (status, False)
        assert folder.exists() == drives
    finally:
        window.kill()


def test_an_error_ends_the_window_without_panda3ds_traceback():
    error, stopped = RecordingError("driven: exists already"), list[bool]()
    window: Any = SimpleNamespace(failed=None, advance=Mock(side_effect=error))
    window.task_mgr = SimpleNamespace(stop=lambda: stopped.append(True))
    task: Any = SimpleNamespace(done=0, cont=1)
    assert Window.tick(window, task) == task.done
    assert window.failed is error and stopped == [True]


@pytest.mark.parametrize(("share", "saved"), [(0.95, 5), (0.01, -2), (0.2, 500)])
def test_a_jump_does_not_count_as_driven(share, saved):
    """Neither one to a place before the lap's start nor one ahead brings the car nearer to the lap's end."""
    run = Run(Track("lake"))
    window: Any = SimpleNamespace(simulation=run, saved=(saved % run.track.length, 0.0))
    run.s = run.travelled = share * run.track.length
    Window.act(window, "jump")
    ahead = saved > share * run.track.length
    assert run.laps == 0 and run.s == saved % run.track.length
    assert run.travelled == pytest.approx(saved - ahead * run.track.length)


def test_however_often_a_jump_leads_ahead_the_next_lap_from_the_start_counts():
    run = Run(Track("lake"))
    window: Any = SimpleNamespace(simulation=run, saved=(500.0, 0.0))
    run.s = run.travelled = 500.0
    for _ in range(3):
        run.s, run.travelled = 400.0, run.travelled - 100
        Window.act(window, "jump")
    assert run.travelled == pytest.approx(500 - run.track.length), "500 m into the lap before the first"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux names its screen in $DISPLAY")
def test_without_a_screen_it_reports_that(tmp_path):
    elsewhere = {"DISPLAY": ":65535"}  # without the variable, panda3d takes a desktop's screen, :0
    done = python("-m", "simulator", "window", "--folder", tmp_path / "x", env=elsewhere)
    assert done.returncode == 2
    assert "DISPLAY" in done.stderr and "Traceback" not in done.stderr
