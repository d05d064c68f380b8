"""The bodies of `gradients_vs_peers.py` in Newton, whose gradients are those of a Warp tape, in reverse mode only."""

import time

import newton
import numpy as np
import warp as wp
from peer_engines import CASES, DISCS, RADIUS, thetas


@wp.kernel
def component(q: wp.array(dtype=wp.transform), body: int, axis: int, out: wp.array(dtype=float)):
    out[0] = wp.transform_get_translation(q[body])[axis]


def model_of(name, theta):
    """The model, and where and how fast the bodies begin."""
    floor = name == "one bounce"
    count = {"one bounce": 1, "two discs": 2, "three discs": 3}[name]
    gravity = (0.0, 0.0, -float(theta[3]) if floor else 0.0)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=gravity)
    surface = newton.ModelBuilder.ShapeConfig(mu=0.0, restitution=float(theta[0]), density=0.0)
    velocities = np.zeros((count, 6), np.float32)
    velocities[0, [0, 2]] = (0.0, theta[2]) if floor else theta[2:]
    for k in range(count):
        x, y = (0.0, theta[1]) if floor else DISCS[k]
        mass = float(theta[1]) if k == 1 else 1.0
        inertia = wp.mat33((0.4 * mass * RADIUS[name] ** 2 * np.eye(3)).ravel().tolist())
        pose = wp.transform(wp.vec3(float(x), 0.0, float(y)), wp.quat_identity())
        body = builder.add_body(xform=pose, mass=mass, inertia=inertia, lock_inertia=True)
        builder.add_shape_sphere(body, radius=RADIUS[name], cfg=surface)
    if floor:
        builder.add_ground_plane(cfg=surface)
    return builder.finalize(device="cpu", requires_grad=True), velocities


def slopes(name, model, first):
    """Derivatives by theta of what the tape was run back from."""
    position, velocity = first.body_q.grad.numpy(), first.body_qd.grad.numpy()
    e = model.shape_material_restitution.grad.numpy().sum()
    if name == "one bounce":
        return [e, position[0, 2], velocity[0, 2], -model.gravity.grad.numpy()[0, 2]]
    inverse = model.body_inv_mass.numpy()[1]
    mass = model.body_mass.grad.numpy()[1] - inverse**2 * model.body_inv_mass.grad.numpy()[1]
    return [e, mass, velocity[0, 0], velocity[0, 2]]


def of_newton(name, rate):
    """As `of_jax`; CPU-seconds are those of the first run, forth and back, beyond a second one."""
    wp.config.quiet = True
    wp.init()
    wp.set_device("cpu")
    steps, ends, jacobians, spent = round(CASES[name][1] * rate), [], [], []
    dt = CASES[name][1] / steps
    for theta in [thetas(name)[0], *thetas(name)]:
        began = time.process_time()
        model, velocities = model_of(name, theta)
        solver = newton.solvers.SolverXPBD(model, enable_restitution=True)
        pipeline, control = newton.CollisionPipeline(model, requires_grad=True), model.control()
        states = [model.state() for _ in range(steps + 1)]
        contacts = [pipeline.contacts() for _ in range(steps)]
        states[0].body_qd.assign(velocities)
        outputs = [(k, axis) for k in range(model.body_count) for axis in (0, 2)]
        read = [wp.zeros(1, dtype=float, requires_grad=True) for _ in outputs]
        tape = wp.Tape()
        with tape:
            for before, after, touching in zip(states, states[1:], contacts, strict=False):
                pipeline.collide(before, touching)
                before.clear_forces()
                solver.step(before, after, control, touching, dt)
            for (body, axis), out in zip(outputs, read, strict=True):
                wp.launch(component, dim=1, inputs=[states[-1].body_q, body, axis], outputs=[out])
        rows = []
        for out in read:
            tape.backward(loss=out)
            rows.append(slopes(name, model, states[0]))
            tape.zero()
        ends.append([float(out.numpy()[0]) for out in read])
        jacobians.append(rows)
        spent.append(time.process_time() - began)
    x = np.array(ends[1:]).reshape(len(ends) - 1, -1, 2)
    jac = np.array(jacobians[1:], float).reshape(*x.shape, 4)
    return x, jac, jac[0].tolist(), [max(spent[0] - spent[1], 0.0)]
