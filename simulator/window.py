"""The window: a person drives and records, or watches drive.py drive and takes over from it."""

import math
import time
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
from direct.gui.OnscreenImage import OnscreenImage
from direct.gui.OnscreenText import OnscreenText
from direct.showbase.ShowBase import ShowBase
from direct.task.Task import Task
from panda3d import core

from cloning.base.errors import SimulatorError, UserError
from cloning.base.frame import FRAME
from cloning.recordings.writer import RecordingWriter, SampleClock, check_name_of_corrections
from cloning.road.camera import CAMERA_POSITIONS, CAMERA_YAW, MOUNT_PITCH
from cloning.road.disturbances import Disturbance
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator.cameras import FAR_PLANE, NEAR_PLANE, Cameras
from simulator.car import STEP
from simulator.client import RemoteDriver
from simulator.controls import ACTIONS, HELD, HELP, Controls, Sticks, balance
from simulator.film import place_chase_camera
from simulator.record import write_row
from simulator.run import Run
from simulator.world import INSIDE, OUTSIDE, Scene, configure_engine, make_texture

SIZE = 960, 540
FIELD_OF_VIEW = 80  # degrees, horizontal; in a flatter window more, so that it sees the wheels of the car from behind
MAX_DELAY = 0.2  # s of physics that are caught up after a slow frame; the rest is skipped
SLOW_FRAMES = 3  # one after another, of which the window tells
STRAIGHT = 40.0  # m of the straight on which a person starts
TOLD_TIME = 4.0  # s for which the window tells of a departure, or of time that was skipped
CHASE_TIME = 0.3  # s: time constant with which the camera follows the car's turns
LETTERS, MARGIN = 0.06, 0.05  # height of a line, and distance from the window's edge; its height is 2
CORNER, CORNER_SIZE = (0.45, 0, 0.4), (0.4, 1, 0.2)  # middle and half the size of what a disturbed camera sees
BAR = 0.5  # half the width of the bar that shows the steering

BUTTONS = {
    "a": core.GamepadButton.face_a(),
    "b": core.GamepadButton.face_b(),
    "x": core.GamepadButton.face_x(),
    "y": core.GamepadButton.face_y(),
    "up": core.GamepadButton.dpad_up(),
    "down": core.GamepadButton.dpad_down(),
}


class Gamepad:
    """The first gamepad that panda3d finds."""

    def __init__(self, manager: core.InputDeviceManager | None = None):
        """manager: finds the devices; panda3d's own by default."""
        self.manager = manager or core.InputDeviceManager.get_global_ptr()

    def read(self) -> Sticks | None:
        """Return the state of sticks and buttons, or None while no gamepad is connected."""
        self.manager.update()
        pads = self.manager.get_devices(core.InputDevice.DeviceClass.gamepad)
        if not len(pads):
            return None
        pad = pads[0]
        pad.poll()
        throttle, steering = pad.find_axis(core.InputDevice.Axis.left_y), pad.find_axis(core.InputDevice.Axis.right_x)
        held = {name for name, handle in BUTTONS.items() if pad.find_button(handle).pressed}
        return Sticks(throttle.value, steering.value, held)


def corner_texture(frame: np.ndarray) -> core.Texture:
    """Return a texture with a frame, uint8 (160, 320, 3), RGB; the renderer takes powers of two only."""
    return make_texture(cv2.resize(frame, (512, 256)), repeat=False, mipmaps=False)


class Window(ShowBase):
    """The window; its run is `simulation`, because ShowBase has a method `run`."""

    failed: UserError | None = None  # what has ended it

    def __init__(
        self,
        track: Track,
        folder: str | Path,
        look: int = 0,
        server: tuple[str, int] | None = None,
        disturbance: Disturbance | None = None,
    ):
        """Open the window. Raises SimulatorError, and RecordingError for a name that does not say what is recorded.

        folder: of the recording, created when recording first starts; server: host and port of drive.py if it drives.
        Then only what the person drives is recorded: the corrections. disturbance: of what the car's cameras see.
        """
        if server:
            check_name_of_corrections(folder)
        configure_engine()
        try:
            super().__init__(windowType="onscreen")
        except Exception as error:
            raise SimulatorError("cannot open a window: connect a screen (on Linux, set DISPLAY)") from error
        properties = core.WindowProperties()
        properties.set_title(f"{track.name} {track.direction}")
        properties.set_size(*SIZE)
        self.win.request_properties(properties)
        self.disable_mouse()
        self.simulation = Run(track, "autonomous" if server else "training")
        if not server and track.closed:
            self.simulation.s = track.straight(STRAIGHT)
            self.simulation.set_back()
        self.scene = Scene.of(track.source, look)
        self.scene.root.reparent_to(self.render)
        self.cameras = Cameras(self.scene, disturbance=disturbance)
        self.controls, self.gamepad = Controls(), Gamepad()
        self.remote: RemoteDriver | None = None
        self.by_hand = not server  # whether the person drove before the last frame
        self.started = bool(server)  # until somebody drives, the car stands still, also on a slope
        if server:
            host, port = server
            self.remote = RemoteDriver(host, port, Cameras(self.scene, ("center",), disturbance))
        self.corner: OnscreenImage | None = None
        if disturbance:
            black = corner_texture(np.zeros(FRAME, np.uint8))
            self.corner = OnscreenImage(black, parent=self.a2dBottomLeft, pos=CORNER, scale=CORNER_SIZE)
        self.seen = self.remote.cameras if self.remote else Cameras(self.scene, ("center",), disturbance)
        self.seen_clock = SampleClock()
        self.folder, self.clock, self.recording_on = folder, SampleClock(), False
        self.recording: RecordingWriter | None = None
        self.saved = (self.simulation.s, 0.0)  # position to jump back to: m along the track, lateral offset in m
        self.chase = True
        self.camLens.set_near_far(NEAR_PLANE, FAR_PLANE)
        self.looks: core.Vec3 | None = None  # the chase camera's direction
        self.told, self.told_until = "", 0.0  # what the middle of the window tells, until this time.monotonic()
        self.departures = self.slow = 0  # departures that it has told of; slow frames one after another
        self.add_texts()
        self.accept("aspectRatioChanged", self.fit)
        self.fit()
        for key in ACTIONS:
            if not key.startswith("pad "):
                self.accept(key, self.controls.press, [key])
        self.simulated_until = time.monotonic()
        self.task_mgr.add(self.tick, "tick")

    def add_texts(self) -> None:
        """Add the status, the help, the message in the middle, the mark of a recording and the steering's bar."""
        style = {"scale": LETTERS, "fg": (1, 1, 1, 1), "mayChange": True}
        left, corner = core.TextNode.A_left, (MARGIN, -MARGIN - LETTERS)
        self.text = OnscreenText("", parent=self.a2dTopLeft, pos=corner, align=left, bg=(0, 0, 0, 0.5), **style)
        self.message = OnscreenText("", pos=(0, 0.35), bg=(0.6, 0.05, 0, 0.8), **style)
        font = self.loader.load_font("cmtt12")
        self.help = OnscreenText(HELP, pos=(-1.1, 0.55), align=left, bg=(0, 0, 0, 0.8), font=font, **style)
        self.help.hide()
        disc = np.zeros((64, 64, 4), np.uint8)
        cv2.circle(disc, (32, 32), 28, (255, 255, 255, 255), -1, cv2.LINE_AA)
        disc = make_texture(disc, repeat=False, mipmaps=False)
        place = (-MARGIN - LETTERS, 0, -MARGIN - LETTERS)
        self.dot = OnscreenImage(disc, parent=self.a2dTopRight, pos=place, scale=LETTERS * 0.8, color=(1, 0, 0, 1))
        self.dot.set_transparency(core.TransparencyAttrib.M_alpha)
        bar = core.LineSegs("steering")
        bar.set_thickness(2)
        for x, height in ((-BAR, 0.03), (0, 0.03), (BAR, 0.03)):
            bar.move_to(x, 0, -height)
            bar.draw_to(x, 0, height)
        bar.move_to(-BAR, 0, 0)
        bar.draw_to(BAR, 0, 0)
        holder = self.a2dBottomCenter.attach_new_node(bar.create())
        holder.set_z(2 * MARGIN)
        self.knob = OnscreenImage(disc, parent=holder, scale=0.03, color=(1, 0.8, 0.25, 1))
        self.knob.set_transparency(core.TransparencyAttrib.M_alpha)
        self.device = OnscreenText("", parent=holder, pos=(BAR + MARGIN, -LETTERS / 4), align=left, **style)

    def fit(self) -> None:
        """Let the view and the texts fit the window's shape."""
        aspect = self.get_aspect_ratio()
        flatter = max(1.0, aspect * SIZE[1] / SIZE[0])
        self.camLens.set_fov(2 * math.degrees(math.atan(flatter * math.tan(math.radians(FIELD_OF_VIEW / 2)))))
        width = 2 * max(1.0, aspect)
        self.text.setWordwrap((width - 2 * MARGIN - 3 * LETTERS) / LETTERS)
        self.message.setWordwrap((width - 4 * MARGIN) / LETTERS)
        size = min(LETTERS, (width - 4 * MARGIN) / 34)  # the help's lines have at most 60 letters of half its height
        self.help.setScale(size)
        self.help.setPos(-17 * size, 0.55 * size / LETTERS)

    def tell(self, words: str) -> None:
        """Show words in the middle of the window for TOLD_TIME."""
        self.told, self.told_until = words, time.monotonic() + TOLD_TIME

    def held(self) -> set[str]:
        """Return the driving keys that are down."""
        watcher, keys = self.mouseWatcherNode, {}
        for arrow, letter in HELD.values():
            keys[arrow] = getattr(core.KeyboardButton, arrow.removeprefix("arrow_"))()
            keys[letter] = core.KeyboardButton.ascii_key(letter)
        return {name for name, handle in keys.items() if watcher.is_button_down(handle)}

    def mouse(self) -> float | None:
        """Return the mouse's horizontal position in the window, -1..1, or None while its left button is up."""
        watcher = self.mouseWatcherNode
        if watcher.has_mouse() and watcher.is_button_down(core.MouseButton.one()):
            return float(watcher.get_mouse_x())
        return None

    def tick(self, task: Task) -> int:
        """Call `advance` before each frame; panda3d calls this, and would print the traceback of an error."""
        try:
            self.advance()
        except UserError as error:
            self.failed = error
            self.task_mgr.stop()
        return int(task.done if self.failed else task.cont)

    def advance(self) -> None:
        """Simulate the time since the last frame and show the result. Raises UserError."""
        now = time.monotonic()
        held, mouse, pad = self.held(), self.mouse(), self.gamepad.read()
        by_hand = not self.remote or balance(held, "up", "down") != 0
        if not self.started:
            self.simulated_until = now
            self.controls.step(held, mouse, pad)
            self.started = self.controls.throttle != 0
        if self.remote:
            self.remote.poll(by_hand, self.simulation)
        if by_hand and not self.by_hand:
            self.begin_drive()
        self.by_hand = by_hand
        driver: Controls | RemoteDriver = self.remote if self.remote and not by_hand else self.controls
        self.slow = self.slow + 1 if now - self.simulated_until > MAX_DELAY else 0
        if self.slow == SLOW_FRAMES:
            self.tell("This computer is too slow for the picture: time passes more slowly. Make the window smaller.")
        while now - self.simulated_until >= STEP:
            self.simulated_until = max(self.simulated_until + STEP, now - MAX_DELAY)
            self.controls.step(held, mouse, pad, self.simulation.speed_mph)
            self.simulation.car.speed_limit = self.controls.set_speed * MPH
            if self.simulation.at_end and self.recording_on:
                self.begin_drive()
            self.simulation.step(driver.steering, driver.throttle)
            if self.recording and self.recording_on and by_hand and self.clock.due(self.simulation.time):
                write_row(self.recording, self.cameras, self.simulation)
        for action in self.controls.take_actions():
            self.act(action)
        for departure in self.simulation.departures[self.departures :]:
            self.tell(
                f"A wheel left the road on the {departure.side} at {departure.speed / MPH:.0f} mph.\n"
                "The car is back on the road's centre, at rest."
            )
        self.departures = len(self.simulation.departures)
        self.show(by_hand)

    def begin_drive(self) -> None:
        """Let what is recorded from now on be a drive of its own."""
        self.clock = SampleClock(self.simulation.time)
        self.cameras.disturb(self.cameras.disturbance)
        if self.recording:
            self.recording.begin_drive()

    def act(self, action: str) -> None:
        """Do what a key or button stands for; action: of `Controls.take_actions`."""
        run = self.simulation
        match action:
            case "record":
                if self.recording is None:
                    self.recording = RecordingWriter(self.folder, start=datetime.now())
                self.recording_on = not self.recording_on
                self.begin_drive()
            case "save":
                self.saved = (run.s, run.offset)
            case "jump":
                # Not forward, else a lap could end that was not driven; nor back further than into the lap before it.
                length = run.track.length
                back = run.travelled - (run.s - self.saved[0]) % length
                run.travelled = max(back, (run.laps - 1) * length + back % length)
                run.s, run.at_end = self.saved[0], False
                run.set_back(self.saved[1])
            case "view":
                self.chase = not self.chase
            case "help":
                (self.help.show if self.help.is_hidden() else self.help.hide)()
            case "quit":
                self.userExit()  # `finish` follows, as after any other end

    def finish(self) -> None:
        """Close the recording and the connection."""
        if self.recording:
            self.recording.close()
        if self.remote:
            self.remote.close()

    def show(self, by_hand: bool) -> None:
        """Place the camera and write the status lines; by_hand: a person drives."""
        run = self.simulation
        transform = run.car.node.get_transform()
        self.scene.move_car(transform)
        self.scene.move_parts(run.steering, run.distance, run.throttle)
        self.cam.node().set_camera_mask(OUTSIDE if self.chase else INSIDE)
        if self.chase:
            self.camera.reparent_to(self.render)
            turn = 1 - math.exp(-core.ClockObject.get_global_clock().get_dt() / CHASE_TIME)
            self.looks = place_chase_camera(self.camera, transform, self.looks, turn)
        else:
            self.camera.reparent_to(self.scene.car)
            self.camera.set_pos_hpr(*CAMERA_POSITIONS["center"], -CAMERA_YAW, -MOUNT_PITCH, 0)
        lines = [
            f"{run.speed_mph:4.1f} mph",
            f"lap {run.laps + 1}   {run.time:.0f} s   departures {len(run.departures)}",
        ]
        if by_hand:  # drive.py has a set speed of its own
            lines[0] += f"   at most {self.controls.set_speed} mph" + "   cruise" * self.controls.cruise
        if not self.started:
            lines.append("W or the up arrow: drive")
        if self.remote:
            connected = self.remote.connection is not None
            lines.append("you drive, until you let go of W and S" if by_hand and connected else self.remote.state)
        if self.recording:
            state = "recording stopped"
            if self.recording_on:
                state = "recording" if by_hand else "recording when you drive"
            lines.append(f"{state}: {self.recording.rows} rows in {self.recording.folder}")
        if self.corner:
            if not self.remote and self.seen_clock.due(run.time):
                self.seen.frames(transform)
            if self.seen.last is not None:
                self.corner.set_texture(corner_texture(self.seen.last[0]), 1)
            lines.append(f"in the corner: what the car's camera sees, {self.seen.disturbance}")
        lines.append("F1: help")
        self.text.setText("\n".join(lines))
        self.message.setText(self.told if time.monotonic() < self.told_until else "")
        (self.dot.show if self.recording and self.recording_on and by_hand else self.dot.hide)()
        self.knob.set_x(BAR * run.steering)
        self.device.setText(self.controls.device if by_hand else "drive.py")
