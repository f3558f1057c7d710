"""The driver's controls against the original's, with a fake gamepad, and the window with real key presses."""

import os
import shutil
import subprocess
import sys
import time

import pytest
from panda3d.core import GamepadButton, InputDevice

from simulator.controls import Controls, Sticks
from simulator.window import Gamepad


def test_keys_steer_a_twentieth_a_step_and_let_go_as_fast():
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


@pytest.mark.parametrize(
    ("held", "throttle"),
    [({"w"}, 1), ({"arrow_up"}, 1), ({"s"}, -1), ({"arrow_down"}, -1), ({"w", "s"}, 0), (set(), 0)],
)
def test_keys_throttle_and_brake(held, throttle):
    controls = Controls()
    controls.step(held)
    assert controls.throttle == throttle


def test_the_mouse_steers_by_how_far_it_is_dragged():
    controls = Controls()
    controls.step(set(), mouse=0.2)
    assert controls.steering == 0
    controls.step(set(), mouse=0.7)
    assert controls.steering == pytest.approx(0.5)
    controls.step(set(), mouse=-1.0)
    assert controls.steering == -1
    controls.step(set())
    assert controls.steering == pytest.approx(-0.95)


def test_cruise_holds_the_throttle_until_the_brake():
    controls = Controls()
    controls.press("space")
    controls.step(set())
    assert controls.throttle == 0.4
    controls.step({"w"})
    assert controls.throttle == 1
    controls.step({"s"})
    controls.step(set())
    assert controls.throttle == 0


class Device:
    """A Logitech F310 as panda3d presents it: axes and buttons by name."""

    def __init__(self):
        self.axes = {
            InputDevice.Axis.left_x: 0.9,
            InputDevice.Axis.left_y: 0.0,
            InputDevice.Axis.right_x: 0.0,
            InputDevice.Axis.right_y: -0.9,
        }
        self.down = set()

    def poll(self):
        pass

    def find_axis(self, axis):
        return type("Axis", (), {"value": self.axes[axis]})

    def find_button(self, handle):
        return type("Button", (), {"pressed": handle in self.down})


class Manager:
    def __init__(self, *devices):
        self.devices = devices

    def update(self):
        pass

    def get_devices(self, kind):
        assert kind == InputDevice.DeviceClass.gamepad
        return self.devices


def test_no_gamepad_is_no_trouble():
    assert Gamepad(Manager()).read() is None


def test_the_f310s_sticks():
    device, controls = Device(), Controls()
    pad = Gamepad(Manager(device))
    controls.step(set(), pad=pad.read())
    assert (controls.steering, controls.throttle) == (0, 0)  # the other axes drive nothing
    device.axes[InputDevice.Axis.left_y] = 1.0
    device.axes[InputDevice.Axis.right_x] = -1.0
    controls.step(set(), pad=pad.read())
    assert (controls.steering, controls.throttle) == (-1, 1)
    device.axes[InputDevice.Axis.right_x] = 0.05  # a stick that does not quite come back
    for _ in range(25):
        controls.step(set(), pad=pad.read())
    assert controls.steering == pytest.approx(0)


@pytest.mark.parametrize(
    ("button", "action"),
    [
        (GamepadButton.face_x(), "save"),
        (GamepadButton.face_y(), "jump"),
        (GamepadButton.face_b(), "record"),
    ],
)
def test_the_f310s_buttons_act_once_a_press(button, action):
    device, controls = Device(), Controls()
    pad = Gamepad(Manager(device))
    device.down = {button}
    for _ in range(5):
        controls.step(set(), pad=pad.read())
    assert controls.take_actions() == [action]
    device.down = set()
    controls.step(set(), pad=pad.read())
    device.down = {button}
    controls.step(set(), pad=pad.read())
    assert controls.take_actions() == [action]


def test_the_f310s_cruise_and_set_speed():
    device, controls = Device(), Controls()
    pad = Gamepad(Manager(device))
    for button in [GamepadButton.dpad_down()] * 6 + [GamepadButton.dpad_up()] * 2 + [GamepadButton.face_a()]:
        device.down = {button}
        controls.step(set(), pad=pad.read())
        device.down = set()
        controls.step(set(), pad=pad.read())
    assert controls.set_speed == 30 - 6 + 2
    assert controls.throttle == 0.4
    for _ in range(40):
        controls.press("pad up")
    assert controls.set_speed == 30


def test_other_pads_come_through_the_same_mapping():
    controls = Controls()
    controls.step(set(), pad=Sticks(throttle=-0.5, steering=0.5, buttons={"b"}))
    assert controls.throttle < -0.4
    assert controls.steering > 0.4
    assert controls.take_actions() == ["record"]


def until(condition, seconds=40):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.skipif(not (shutil.which("Xvfb") and shutil.which("xdotool")), reason="needs Xvfb and xdotool")
def test_the_window_is_driven_and_records(tmp_path):
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x640x24"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        display = ":" + os.read(read, 16).decode().strip()
        environment = {**os.environ, "DISPLAY": display}

        def press(*arguments):
            subprocess.run(["xdotool", *arguments], env=environment, check=True, stdout=subprocess.DEVNULL)

        folder = tmp_path / "driven"
        window = subprocess.Popen(
            [sys.executable, "-m", "simulator", "window", "--folder", str(folder)],
            env=environment,
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        try:
            press("search", "--sync", "--name", "lake ccw")
            log = folder / "driving_log.csv"

            def recording():
                press("key", "r")
                end = time.monotonic() + 2
                while not log.exists() and time.monotonic() < end:
                    time.sleep(0.05)
                return log.exists()

            until(recording)  # the first presses may come before the window listens
            press("keydown", "w", "keydown", "d")

            def row():
                rows = log.read_text(encoding="utf-8").splitlines()
                return [float(value) for value in rows[-1].split(",")[3:]] if rows else [0, 0, 0, 0]

            until(lambda: row()[0] > 0.1 and row()[1] == 1 and row()[3] > 0.1)
            press("keyup", "w", "keyup", "d", "key", "Escape")
            assert window.wait(20) == 0
        finally:
            window.kill()
    finally:
        server.kill()
        server.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux names its screen in $DISPLAY")
def test_without_a_screen_it_reports_that(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, "-m", "simulator", "window", "--folder", str(tmp_path / "x")],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 2
    assert "DISPLAY" in done.stderr
    assert "Traceback" not in done.stderr
