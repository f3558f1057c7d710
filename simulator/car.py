"""The simulator's car as Bullet's ray-cast vehicle.

Figures without another source are those of Unity's scene file, in metres, kilograms, newtons and seconds.
"""

import math

from panda3d.bullet import BulletBoxShape, BulletRigidBodyNode, BulletVehicle, BulletWorld, ZUp
from panda3d.core import NodePath, Point3, TransformState, Vec3

from cloning.road.motion import FULL_LOCK, MPH, REAR_AXLE, TOP_SPEED_MPH
from cloning.road.track import Place

STEP = 0.02  # s of physics in one step
TOP_SPEED = TOP_SPEED_MPH * MPH
# Hub's position to the right, forward and up; radius
WHEELS = (
    (-1.0, 1.27, 0.45, 0.335),
    (1.0, 1.27, 0.45, 0.335),
    (-1.0, -REAR_AXLE, 0.50, 0.37),
    (1.0, -REAR_AXLE, 0.50, 0.37),
)
MASS = 1000.0
TORQUE, REVERSE_TORQUE, BRAKE_TORQUE = 2000.0, 150.0, 20000.0  # Nm: all wheels, all wheels, each wheel
TORQUE_PER_STEP = 60.0  # Nm: traction control lets the torque build up over two thirds of a second
DOWNFORCE = 100.0  # N per m/s
SETTLING_STEPS = 50  # until the car rests on its springs
GRIP = 2500.0  # N: braking force of a locked wheel
# The real car's yaw rate at 30 mph is 0.8 times v/L tan(angle) by regression over single frames, but 1.06 times it over
# whole laps. An understeering car with this characteristic speed has 0.86 times v/L tan(angle) at 30 mph: within a
# tenth of the first figure, as close to the second as that allows, and v/L tan(angle) at walking pace.
CHARACTERISTIC_SPEED = 2.45 * TOP_SPEED  # m/s
MIN_BRAKING_SPEED = 5 * MPH  # m/s: below, a negative throttle reverses
HUB_RAISE = 0.2175  # m: the hubs are higher than in Unity, because Bullet fixes the springs' rest length


class Car:
    """The car in a physics world; `node` is its pose, `speed_limit` in m/s holds a set speed."""

    def __init__(self, physics: BulletWorld):
        """physics: with the ground in it, see `world.build_physics`."""
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
        for right, forward, up, radius in WHEELS:
            wheel = self.vehicle.create_wheel()
            wheel.set_chassis_connection_point_cs(Point3(right, forward, up + HUB_RAISE))
            wheel.set_front_wheel(forward > 0)
            wheel.set_wheel_direction_cs(Vec3(0, 0, -1))
            wheel.set_wheel_axle_cs(Vec3(1, 0, 0))
            wheel.set_wheel_radius(radius)
            wheel.set_max_suspension_travel_cm(20)
            wheel.set_suspension_stiffness(70)  # times the mass: 70000 N/m
            wheel.set_wheels_damping_relaxation(3.5)
            wheel.set_wheels_damping_compression(3.5)
            wheel.set_friction_slip(3.0)
            wheel.set_roll_influence(0.05)
        self.torque = 0.0
        self.speed_limit = TOP_SPEED

    def place(self, place: Place) -> None:
        """Place the car at rest at a pose, parallel to the road."""
        pitch = math.atan(place.grade)
        self.node.set_hpr(math.degrees(place.heading) - 90, math.degrees(pitch), 0)
        self.node.set_pos(place.x, place.y, place.z)
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
                self.vehicle.set_brake(GRIP * STEP, i)
            self.physics.do_physics(STEP, 1, STEP)

    def step(self, steering: float, throttle: float) -> None:
        """Drive for one physics step.

        steering: -1..1, positive right, 25 degrees at 1; throttle: -1..1, negative brakes, below 5 mph reverses.
        """
        speed = self.speed
        angle = math.tan(math.radians(FULL_LOCK * max(-1.0, min(1.0, steering))))
        angle /= 1 + (speed / CHARACTERISTIC_SPEED) ** 2
        for front in (0, 1):
            self.vehicle.set_steering_value(-math.degrees(math.atan(angle)), front)
        rolling_forward = self.vehicle.get_current_speed_km_hour() / 3.6 > 0
        change = TORQUE_PER_STEP if throttle > 0 else -TORQUE_PER_STEP
        self.torque = max(0.0, min(TORQUE, self.torque + change))
        drive, brake = self.torque * max(0.0, min(1.0, throttle)), 0.0
        if throttle < 0:
            if speed > MIN_BRAKING_SPEED and rolling_forward:
                brake = min(BRAKE_TORQUE * min(1.0, -throttle) / WHEELS[0][3], GRIP) * STEP
            else:
                drive = REVERSE_TORQUE * max(-1.0, throttle)
        for i, (_, _, _, radius) in enumerate(WHEELS):
            self.vehicle.apply_engine_force(drive / 4 / radius, i)
            self.vehicle.set_brake(brake, i)
        down = self.node.get_quat().get_up() * (-DOWNFORCE * speed)
        self.body.apply_central_force(down)
        self.physics.do_physics(STEP, 1, STEP)
        velocity = self.body.get_linear_velocity()
        if velocity.length() > self.speed_limit:
            self.body.set_linear_velocity(velocity * (self.speed_limit / velocity.length()))
