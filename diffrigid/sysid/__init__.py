"""System identification: from measured columns to parameters with intervals."""

from diffrigid.sysid.covariance import bootstrap, from_jacobian, sandwich
from diffrigid.sysid.fit import fit
from diffrigid.sysid.free import Free, direction, each, inertia, interval, positive, prior, real, rotation, shares
from diffrigid.sysid.losses import huber, squares, student
from diffrigid.sysid.records import Record
from diffrigid.sysid.result import Fit, Parameter, load_fit
from diffrigid.sysid.sensors import Channel, Homography, Marker, Pinhole, Separation
from diffrigid.sysid.setup import jacobian_matrix, make_problem, residual_vector, start_vector

__all__ = [
    "Channel", "Fit", "Free", "Homography", "Marker", "Parameter", "Pinhole", "Record", "Separation",
    "bootstrap", "direction", "each", "fit", "from_jacobian", "huber", "inertia", "interval", "jacobian_matrix",
    "load_fit", "make_problem", "positive", "prior", "real", "residual_vector", "rotation", "sandwich", "shares",
    "squares", "start_vector", "student",
]  # fmt: skip
