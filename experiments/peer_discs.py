"""Three discs that collide twice, in closed form and in each engine of `sysid_vs_peers.py`, and a fit with each.

theta = (restitution, mass of the middle disc, v of the first); the outer discs have mass 1, and there is no gravity. A
simulation returns the positions of the discs at the frames, (FRAMES, 3, 2) [m]; a fit takes a record of such and where
to start, and returns the values of theta and the ends of their 95 % intervals, (3, 4).
"""

import contextlib
import io
import math

import numpy as np

RADIUS, FRAMES, HERTZ = 0.4, 120, 60
START = np.array([(0.0, 0.0), (1.5, 0.1), (3.2, 0.35)])  # [m]
T = np.arange(FRAMES) / HERTZ
NOISE = 3e-3  # [m]
LOW, HIGH = np.array([0.0, 0.05, -5.0, -5.0]), np.array([1.0, 20.0, 5.0, 5.0])  # of theta, for the peers


def exact(theta):
    """Impacts at their true times: the closed form that records are made with."""
    e, mass, *v0 = theta
    x, v, m, t = START.copy(), np.array([v0, (0.0, 0.0), (0.0, 0.0)]), np.array([1.0, mass, 1.0]), 0.0
    out = np.zeros((FRAMES, 3, 2))
    while True:
        hits = [(meeting(x[a] - x[b], v[a] - v[b]), a, b) for a, b in ((0, 1), (1, 2), (0, 2))]
        s, a, b = min(hits)
        now = (T >= t - 1e-12) & (T < t + s)
        out[now] = x + (T[now] - t)[:, None, None] * v
        if t + s > T[-1]:
            return out
        x, t = x + s * v, t + s
        n = (x[a] - x[b]) / np.linalg.norm(x[a] - x[b])
        P = -(1 + e) * n @ (v[a] - v[b]) / (1 / m[a] + 1 / m[b])
        v[a], v[b] = v[a] + P / m[a] * n, v[b] - P / m[b] * n


def meeting(r, v):
    """Time until two discs at distance r, that come together at v, touch; inf if they do not."""
    b, c = r @ v, r @ r - 4 * RADIUS**2
    root = b * b - (v @ v) * c
    return max(c / (-b + math.sqrt(root)), 0.0) if b < 0 and root > 0 else math.inf


def pymunk(theta, steps):
    """Chipmunk, with so many steps a frame."""
    import pymunk

    space, bodies = pymunk.Space(), []
    space.collision_slop = 0.0
    for x, mass, v in zip(START, (1.0, theta[1], 1.0), (tuple(theta[2:]), (0, 0), (0, 0)), strict=True):
        body = pymunk.Body(mass, pymunk.moment_for_circle(mass, 0.0, RADIUS))
        body.position, body.velocity = tuple(x), tuple(v)
        disc = pymunk.Circle(body, RADIUS)
        disc.elasticity, disc.friction = math.sqrt(max(theta[0], 0.0)), 0.0  # those of two shapes are multiplied
        space.add(body, disc)
        bodies.append(body)
    return _frames(lambda: space.step(1 / HERTZ / steps), lambda: [tuple(b.position) for b in bodies], steps)


def box2d(theta, steps):
    """Box2D v3, with so many steps a frame of one sub-step each."""
    import pyb2d3

    world = pyb2d3.World(gravity=(0.0, 0.0), restitution_threshold=0.0)
    world.sleeping_enabled = False
    material, bodies = pyb2d3.surface_material(friction=0.0, restitution=max(float(theta[0]), 0.0)), []
    for x, mass, v in zip(START, (1.0, theta[1], 1.0), (tuple(theta[2:]), (0, 0), (0, 0)), strict=True):
        body = world.create_dynamic_body(position=tuple(x), linear_velocity=tuple(map(float, v)))
        stuff = pyb2d3.shape_def(density=float(mass) / (math.pi * RADIUS**2), material=material)
        body.create_shape(stuff, pyb2d3.circle(radius=RADIUS))
        bodies.append(body)
    found = _frames(lambda: world.step(1 / HERTZ / steps, 1), lambda: [tuple(b.position) for b in bodies], steps)
    bodies.clear()  # a body does not outlive its world
    return found


def _frames(step, read, steps):
    out = np.zeros((FRAMES, 3, 2))
    out[0] = START
    for k in range(1, FRAMES):
        for _ in range(steps):
            step()
        out[k] = read()
    return out


def damping_of(e, stiffness):
    """Damping of a spring that rebounds with e, where it can push and not pull.

    With u = damping / (2 sqrt(stiffness)) and w^2 = 1 - u^2, e = exp(-(u / w) (pi - atan2(2 u w, 1 - 2 u^2))). Source:
    Schwager and Poeschel 2007.
    """
    low, high = 0.0, 0.999
    for _ in range(60):
        u = 0.5 * (low + high)
        w = math.sqrt(1 - u * u)
        rebound = math.exp(-u / w * (math.pi - math.atan2(2 * u * w, 1 - 2 * u * u)))
        low, high = (u, high) if rebound > e else (low, u)
    return 2 * u * math.sqrt(stiffness)


def mujoco_spec(steps, stiffness):
    """The discs as spheres that slide in the plane, with so many steps a frame."""
    import mujoco

    body = (
        '<body pos="{x} {y} 0"><joint name="x{k}" type="slide" axis="1 0 0"/>'
        '<joint name="y{k}" type="slide" axis="0 1 0"/><geom type="sphere" size="0.4" mass="1" condim="1"/></body>'
    )
    return mujoco.MjSpec.from_string(
        f'<mujoco><option timestep="{1 / HERTZ / steps:.12g}" gravity="0 0 0"/><default><geom solimp="0.99 0.99 0.001" '
        f'solref="{-stiffness} -1"/></default><worldbody>'
        + "".join(body.format(x=x, y=y, k=k) for k, (x, y) in enumerate(START))
        + "</worldbody><sensor>"
        + "".join(f'<jointpos name="{axis}{k}" joint="{axis}{k}"/>' for k in range(3) for axis in "xy")
        + "</sensor></mujoco>"
    )


def mujoco_problem(record, start, steps, stiffness):
    """Parameters and residuals of `mujoco.sysid`; initial velocities are no part of a model, but of a rollout."""
    from mujoco import sysid

    def rebound(spec, parameter):
        for geom in spec.geoms:
            geom.solref = [-stiffness, -damping_of(parameter.value[0], stiffness)]

    def weigh(spec, parameter):
        spec.geoms[1].mass = parameter.value[0]

    def roll(models, datas, control_signal, initial_states, param_dicts, **maps):
        states = [state.copy() for state in initial_states]
        for state, values in zip(states, param_dicts, strict=True):
            state[7:9] = values["v"].value  # after the time and six positions
        return sysid.sysid_rollout(models, datas, control_signal, states, **maps)

    def difference(params, predicted, measured, model, return_all, state=None, **rest):
        return (state[steps - 1 :: steps, 1:7] - measured.data) / NOISE, measured, measured

    low, high = LOW + 0.01, HIGH - 0.001
    params, theta = sysid.ParameterDict(), np.clip(start, low + 0.01, high - 0.01)
    params.add(sysid.Parameter("restitution", theta[0], low[0], high[0], modifier=rebound))
    params.add(sysid.Parameter("mass", theta[1], low[1], high[1], modifier=weigh))
    params.add(sysid.Parameter("v", theta[2:], low[2:], high[2:]))
    spec, count = mujoco_spec(steps, stiffness), steps * (FRAMES - 1) + 1
    model = spec.compile()
    control = sysid.TimeSeries(np.arange(count) / HERTZ / steps, np.zeros((count, 0)))
    measured = sysid.TimeSeries.from_names(T[1:], (record - START)[1:].reshape(-1, 6), model)
    first = sysid.create_initial_state(model, np.zeros(6), np.zeros(6))
    runs = sysid.ModelSequences("discs", spec, "record", first, control, measured, allow_missing_sensors=True)
    arguments = {"custom_rollout": roll, "modify_residual": difference, "resample_true": False, "n_threads": 1}
    return params, sysid.build_residual_fn(models_sequences=[runs], **arguments)


def fit_mujoco(record, start, steps, stiffness, **options):
    """By the toolbox of MuJoCo, with its own optimiser and its own intervals."""
    from mujoco import sysid

    params, residuals = mujoco_problem(record, start, steps, stiffness)
    with contextlib.redirect_stdout(io.StringIO()):
        params, found = sysid.optimize(params, residuals, "mujoco", verbose=False, **options)
    last = residuals(found.x, params)[0]
    half = sysid.calculate_intervals([np.ravel(last)], found.jac)[1]
    return np.stack([found.x, found.x - half, found.x + half]), 0.5 * float(np.sum(np.square(last)))


def fit_scipy(simulate, record, start, **options):
    """By `least_squares` of SciPy; intervals from its Jacobian, as those of the others."""
    from scipy.optimize import least_squares
    from scipy.stats import t

    start = np.clip(start, LOW + 0.01, HIGH - 0.01)
    found = least_squares(
        lambda theta: (simulate(theta) - record).ravel() / NOISE, start, bounds=(LOW, HIGH), **options
    )
    freedom = (FRAMES - 1) * 6 - 4
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * 2 * found.cost / freedom
    half = t.ppf(0.975, freedom) * np.sqrt(np.diag(covariance))
    return np.stack([found.x, found.x - half, found.x + half]), found.cost


def fit_pymunk(record, start, steps, **options):
    return fit_scipy(lambda theta: pymunk(theta, steps), record, start, **options)


def fit_box2d(record, start, steps, **options):
    return fit_scipy(lambda theta: box2d(theta, steps), record, start, **options)


def fit_diffrigid(record, start, **options):
    import diffrigid as dr

    def body(mass, x, v):
        return dr.Body(dr.Disc(radius=RADIUS), mass=float(mass), x=tuple(x), v=tuple(map(float, v)))

    parts = zip("abc", (1.0, start[1], 1.0), START, (start[2:], (0, 0), (0, 0)), strict=True)
    world, state = dr.scene({name: body(*rest) for name, *rest in parts}, restitution=float(start[0]))
    data = {"t": T} | {f"{name}.x": record[:, k] for k, name in enumerate("abc")}
    free = {"restitution": dr.interval(0, 1), "b.mass": dr.positive(), "a.v": dr.real()}
    try:
        fit = dr.fit(world, state, data, free=free, progress=False, **options)
    except ValueError:  # it refuses a fit in which the discs miss each other
        return np.full((3, 4), np.nan), math.inf
    rows = [np.concatenate([np.ravel(getattr(p, end)) for p in fit.parameters]) for end in ("value", "low", "high")]
    return np.stack(rows), float(fit.costs[0])


FITS = {"diffrigid": fit_diffrigid, "mujoco": fit_mujoco, "pymunk": fit_pymunk, "pyb2d3": fit_box2d}
