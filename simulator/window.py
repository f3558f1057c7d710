"""The window: a person drives, records, or watches drive.py drive and takes over from it."""

import time
from datetime import datetime

from direct.gui.OnscreenText import OnscreenText
from direct.showbase.ShowBase import ShowBase
from panda3d.core import (
    GamepadButton,
    InputDevice,
    InputDeviceManager,
    KeyboardButton,
    MouseButton,
    TextNode,
    WindowProperties,
)

from cloning.errors import SimulatorError
from cloning.recordings.writer import Clock, RecordingWriter
from cloning.road.camera import CAMERA_POSITIONS, CAMERA_YAW, MOUNT_PITCH
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.car import STEP
from simulator.client import Remote
from simulator.controls import ACTIONS, HELD, HELP, Controls, Sticks
from simulator.film import place_chase_camera
from simulator.run import Run
from simulator.world import INSIDE, OUTSIDE, Scene

SIZE = 960, 540
BEHIND_AT_MOST = 0.2  # s of physics that a slow frame is caught up with; the rest is lost


BUTTONS = {
    "a": GamepadButton.face_a(),
    "b": GamepadButton.face_b(),
    "x": GamepadButton.face_x(),
    "y": GamepadButton.face_y(),
    "up": GamepadButton.dpad_up(),
    "down": GamepadButton.dpad_down(),
}


class Gamepad:
    """The first gamepad that panda3d finds, as the recorder's controls read it."""

    def __init__(self, manager=None):
        """manager: what finds devices, panda3d's own otherwise."""
        self.manager = manager or InputDeviceManager.get_global_ptr()

    def read(self) -> Sticks | None:
        """None while no gamepad is plugged in."""
        self.manager.update()
        pads = self.manager.get_devices(InputDevice.DeviceClass.gamepad)
        if not len(pads):
            return None
        pad = pads[0]
        pad.poll()
        throttle, steering = pad.find_axis(InputDevice.Axis.left_y), pad.find_axis(InputDevice.Axis.right_x)
        held = {name for name, handle in BUTTONS.items() if pad.find_button(handle).pressed}
        return Sticks(throttle.value, steering.value, held)


class Window(ShowBase):
    """`run_` is the drive; ShowBase has a method `run`."""

    def __init__(self, track: Track, folder: str, look: int = 0, server: tuple | None = None):
        """folder: of the recording, made when recording first begins.

        server: drive.py's host and port, where it is to drive. Raises SimulatorError.
        """
        try:
            super().__init__(windowType="onscreen")
        except Exception as error:
            raise SimulatorError("no window can be opened: is there a screen (DISPLAY)?") from error
        properties = WindowProperties()
        properties.set_title(f"{track.name} {track.direction}")
        properties.set_size(*SIZE)
        self.win.request_properties(properties)
        self.disable_mouse()
        self.run_ = Run(track, "autonomous" if server else "training")
        self.scene = Scene(scenery.build(track.name, look))
        self.scene.root.reparent_to(self.render)
        self.cameras = Cameras(self.scene)
        self.controls, self.gamepad = Controls(), Gamepad()
        self.remote = Remote(*server, Cameras(self.scene, ("center",))) if server else None
        self.folder, self.recording, self.clock, self.recording_on = folder, None, Clock(), False
        self.saved = (self.run_.s, 0.0)
        self.chase = True
        self.camLens.set_near_far(0.3, 1000)
        self.camLens.set_fov(80)
        self.text = OnscreenText(
            "",
            pos=(-1.7, 0.9),
            scale=0.06,
            fg=(1, 1, 1, 1),
            shadow=(0, 0, 0, 1),
            align=TextNode.A_left,
            mayChange=True,
        )
        self.help = OnscreenText(
            HELP,
            pos=(-1.1, 0.55),
            scale=0.06,
            fg=(1, 1, 1, 1),
            bg=(0, 0, 0, 0.7),
            align=TextNode.A_left,
            font=self.loader.load_font("cmtt12"),
        )
        self.help.hide()
        for key in ACTIONS:
            if not key.startswith("pad "):
                self.accept(key, self.controls.press, [key])
        self.then = time.monotonic()
        self.task_mgr.add(self.tick, "tick")

    def held(self) -> set:
        """The driving keys that are down."""
        watcher, keys = self.mouseWatcherNode, {}
        for names in HELD.values():
            arrow, letter = names
            keys[arrow] = getattr(KeyboardButton, arrow.removeprefix("arrow_"))()
            keys[letter] = KeyboardButton.ascii_key(letter)
        return {name for name, handle in keys.items() if watcher.is_button_down(handle)}

    def mouse(self) -> float | None:
        watcher = self.mouseWatcherNode
        if watcher.has_mouse() and watcher.is_button_down(MouseButton.one()):
            return watcher.get_mouse_x()
        return None

    def tick(self, task):
        now = time.monotonic()
        held, mouse, pad = self.held(), self.mouse(), self.gamepad.read()
        by_hand = not self.remote or self.controls.pedals(held) != 0
        if self.remote:
            self.remote.answer(by_hand, self.run_)
        while now - self.then >= STEP:
            self.then = max(self.then + STEP, now - BEHIND_AT_MOST)
            self.controls.step(held, mouse, pad)
            self.run_.car.speed_limit = self.controls.set_speed * MPH
            who = self.controls if by_hand else self.remote
            self.run_.step(who.steering, who.throttle)
            if self.recording_on and self.clock.due(self.run_.time):
                self.sample()
        for action in self.controls.take():
            getattr(self, f"do_{action}")()
        self.show(by_hand)
        return task.cont

    def sample(self) -> None:
        run = self.run_
        images = [jpeg(frame) for frame in self.cameras.frames(run.car.node.get_transform())]
        self.recording.add(
            run.time, images, run.steering, max(0.0, run.throttle), max(0.0, -run.throttle), run.speed_mph
        )

    def do_record(self) -> None:
        if self.recording is None:
            self.recording = RecordingWriter(self.folder, begin=datetime.now())
        self.recording_on = not self.recording_on
        self.clock = Clock(self.run_.time)

    def do_save(self) -> None:
        self.saved = (self.run_.s, self.run_.offset)

    def do_jump(self) -> None:
        self.run_.s = self.saved[0]
        self.run_.set_back(self.saved[1])

    def do_view(self) -> None:
        self.chase = not self.chase

    def do_help(self) -> None:
        (self.help.show if self.help.is_hidden() else self.help.hide)()

    def do_quit(self) -> None:
        self.finish()
        self.userExit()

    def finish(self) -> None:
        """Close what is open."""
        if self.recording:
            self.recording.close()
        if self.remote:
            self.remote.close()

    def show(self, by_hand: bool) -> None:
        run = self.run_
        transform = run.car.node.get_transform()
        self.scene.car.set_transform(transform)
        self.scene.look_from(*transform.get_pos())
        self.cam.node().set_camera_mask(OUTSIDE if self.chase else INSIDE)
        if self.chase:
            self.camera.reparent_to(self.render)
            place_chase_camera(self.camera, transform)
        else:
            self.camera.reparent_to(self.scene.car)
            self.camera.set_pos_hpr(*CAMERA_POSITIONS["center"], -CAMERA_YAW, -MOUNT_PITCH, 0)
        lines = [
            f"{run.speed_mph:4.1f} mph   set speed {self.controls.set_speed}   steering {run.steering:+.2f}",
            f"lap {run.laps + 1}   {run.time:.0f} s   departures {len(run.departures)}",
        ]
        if self.controls.cruise:
            lines[0] += "   cruise"
        if self.remote:
            lines.append(f"drive.py: {self.remote.state}" + ("   you steer" if by_hand else ""))
        if self.recording:
            state = "recording" if self.recording_on else "recording stopped"
            lines.append(f"{state}: {self.recording.rows} rows in {self.recording.folder}")
        lines.append("F1 shows the keys")
        self.text.setText("\n".join(lines))
