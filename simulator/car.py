"""The simulator's car as a ray-cast vehicle of the Bullet physics engine.

Constants without another source are from the Unity scene of the real simulator, in metres, kilograms, newtons and
seconds.
"""

import math
from typing import NamedTuple

from panda3d.bullet import BulletBoxShape, BulletRigidBodyNode, BulletVehicle, BulletWorld, ZUp
from panda3d.core import NodePath, Point3, TransformState, Vec3

from cloning.road.motion import FULL_LOCK, MPH, REAR_AXLE, TOP_SPEED_MPH
from cloning.road.track import Pose

STEP = 0.02  # s of physics in one step
TOP_SPEED = TOP_SPEED_MPH * MPH


class Wheel(NamedTuple):
    """A wheel: the position of its hub relative to the car's origin, and its radius, in metres."""

    right: float
    forward: float
    up: float
    radius: float


FRONT_WHEELS = (Wheel(-1.0, 1.27, 0.45, 0.335), Wheel(1.0, 1.27, 0.45, 0.335))
WHEELS = (*FRONT_WHEELS, Wheel(-1.0, -REAR_AXLE, 0.50, 0.37), Wheel(1.0, -REAR_AXLE, 0.50, 0.37))
MASS = 1000.0
TORQUE, REVERSE_TORQUE = 2000.0, 150.0  # Nm, of all four wheels together
BRAKE_TORQUE = 20000.0  # Nm, of each wheel
TORQUE_PER_STEP = 60.0  # Nm: with traction control the torque builds up over two thirds of a second
DOWNFORCE = 100.0  # N per m/s
SETTLING_STEPS = 50  # until the car rests on its springs
MAX_BRAKING_FORCE = 2500.0  # N, of a locked wheel
# The real car's yaw rate at 30 mph is 0.8 times v / wheelbase * tan(wheel angle) by regression over single frames, but
# 1.06 times that over whole laps. A car that understeers with this characteristic speed has a factor of 0.86 at 30 mph:
# within a tenth of the first figure, and no further from the second than necessary. At walking pace its factor is 1.
CHARACTERISTIC_SPEED = 2.45 * TOP_SPEED  # m/s
MIN_BRAKING_SPEED = 5 * MPH  # m/s: below it, a negative throttle reverses
HUB_RAISE = 0.2175  # m by which the hubs are higher than in Unity, because Bullet fixes the rest length of the springs


class Car:
    """The car in a physics world; `node` is its pose, `speed_limit` a speed in m/s that it never exceeds."""

    def __init__(self, physics: BulletWorld):
        """physics: a world that contains the ground, see `world.build_physics`."""
        self.physics = physics
        body = BulletRigidBodyNode("car")
        body.add_shape(BulletBoxShape(Vec3(0.9, 2.0, 0.35)), TransformState.make_pos(Point3(0, -0.15, 0.75)))
        body.set_mass(MASS)
        body.set_deactivation_enabled(False)
        body.set_linear_damping(0.1)
        body.set_angular_damping(0.05)
        self.body, self.node = body, NodePath(body)
        physics.attach(body)
        self.vehicle = BulletVehicle(physics, body)
        self.vehicle.set_coordinate_system(ZUp)
        physics.attach(self.vehicle)
        for wheel in WHEELS:
            bullet_wheel = self.vehicle.create_wheel()
            bullet_wheel.set_chassis_connection_point_cs(Point3(wheel.right, wheel.forward, wheel.up + HUB_RAISE))
            bullet_wheel.set_front_wheel(wheel in FRONT_WHEELS)
            bullet_wheel.set_wheel_direction_cs(Vec3(0, 0, -1))
            bullet_wheel.set_wheel_axle_cs(Vec3(1, 0, 0))
            bullet_wheel.set_wheel_radius(wheel.radius)
            bullet_wheel.set_max_suspension_travel_cm(20)
            bullet_wheel.set_suspension_stiffness(70)  # times the mass: 70000 N/m
            bullet_wheel.set_wheels_damping_relaxation(3.5)
            bullet_wheel.set_wheels_damping_compression(3.5)
            bullet_wheel.set_friction_slip(3.0)
            bullet_wheel.set_roll_influence(0.05)
        self.torque = 0.0
        self.speed_limit = TOP_SPEED

    def place(self, pose: Pose) -> None:
        """Place the car at rest at a pose, parallel to the road."""
        pitch = math.atan(pose.grade)
        self.node.set_hpr(math.degrees(pose.heading) - 90, math.degrees(pitch), 0)
        self.node.set_pos(pose.x, pose.y, pose.z)
        self.body.set_linear_velocity(Vec3(0))
        self.body.set_angular_velocity(Vec3(0))
        self.body.clear_forces()
        self.vehicle.reset_suspension()
        self.torque = 0.0

    @property
    def speed(self) -> float:
        """Speed in m/s, never negative."""
        return self.body.get_linear_velocity().length()

    @property
    def heading(self) -> float:
        """Heading in radians, 0 towards the east, growing counter-clockwise."""
        return math.radians(self.node.get_h() + 90)

    def settle(self) -> None:
        """Let the braked car come to rest on its springs."""
        for _ in range(SETTLING_STEPS):
            for i in range(len(WHEELS)):
                self.vehicle.apply_engine_force(0, i)
                self.vehicle.set_brake(MAX_BRAKING_FORCE * STEP, i)
            self.physics.do_physics(STEP, 1, STEP)

    def step(self, steering: float, throttle: float) -> None:
        """Drive for one physics step.

        steering: -1..1, right positive; throttle: -1..1, where a negative value brakes, or reverses below 5 mph.
        """
        speed = self.speed
        tangent = math.tan(math.radians(FULL_LOCK * max(-1.0, min(1.0, steering))))
        tangent /= 1 + (speed / CHARACTERISTIC_SPEED) ** 2
        for i in range(len(FRONT_WHEELS)):
            self.vehicle.set_steering_value(-math.degrees(math.atan(tangent)), i)
        rolling_forward = self.vehicle.get_current_speed_km_hour() / 3.6 > 0
        change = TORQUE_PER_STEP if throttle > 0 else -TORQUE_PER_STEP
        self.torque = max(0.0, min(TORQUE, self.torque + change))
        drive, brake = self.torque * max(0.0, min(1.0, throttle)), 0.0
        if throttle < 0:
            if speed > MIN_BRAKING_SPEED and rolling_forward:
                brake = min(BRAKE_TORQUE * min(1.0, -throttle) / WHEELS[0].radius, MAX_BRAKING_FORCE) * STEP
            else:
                drive = REVERSE_TORQUE * max(-1.0, throttle)
        for i, wheel in enumerate(WHEELS):
            self.vehicle.apply_engine_force(drive / len(WHEELS) / wheel.radius, i)
            self.vehicle.set_brake(brake, i)
        self.body.apply_central_force(self.node.get_quat().get_up() * (-DOWNFORCE * speed))
        self.physics.do_physics(STEP, 1, STEP)
        velocity = self.body.get_linear_velocity()
        if velocity.length() > self.speed_limit:
            self.body.set_linear_velocity(velocity * (self.speed_limit / velocity.length()))
