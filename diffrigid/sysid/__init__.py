"""System identification: from measured columns to parameters with intervals.

To read it, in the order of a fit; `fit.py` runs it:

    what was measured     columns.py, csv_file.py, records.py, sensors.py, channels.py, times.py
    what is free          free.py, charts.py (kinds), parameters.py (where they are); losses.py
    the problem           setup.py, first_rows.py, problem.py (from z to residuals), clocks.py, points.py (back)
    solvers               levenberg.py, gradient.py, vector.py (for any other); segments.py for long records
    how sure              noise.py, covariance.py, profile.py, sampling.py, diagnosis.py, remarks.py, orders.py
    what comes out        result.py, score.py, intervals.py, summary.py, table.py
    before measuring      design.py
    from the shell        command.py

Letters of array axes: K rows of a column, M numbers of a column, R records, S starts, a shared numbers z, b numbers z
of each record, m residuals.
"""

from diffrigid.sysid.charts import direction, inertia, rotation, shares
from diffrigid.sysid.covariance import bootstrap, from_jacobian, sandwich
from diffrigid.sysid.csv_file import read_csv
from diffrigid.sysid.design import best_launch, blind_spots, expected_intervals
from diffrigid.sysid.fit import fit
from diffrigid.sysid.free import each, interval, positive, prior, real, through
from diffrigid.sysid.gradient import first_order, lbfgs
from diffrigid.sysid.losses import huber, squares, student
from diffrigid.sysid.profile import profile, with_profiles
from diffrigid.sysid.records import Record
from diffrigid.sysid.result import Fit
from diffrigid.sysid.sampling import sample
from diffrigid.sysid.segments import fit_in_pieces, jumps, segments
from diffrigid.sysid.sensors import Channel, Homography, Marker, Pinhole, Separation
from diffrigid.sysid.setup import make_problem
from diffrigid.sysid.summary import Parameter, load_fit
from diffrigid.sysid.vector import jacobian_matrix, residual_vector, start_vector, values_at

__all__ = [
    "Channel",
    "Fit",
    "Homography",
    "Marker",
    "Parameter",
    "Pinhole",
    "Record",
    "Separation",
    "best_launch",
    "blind_spots",
    "bootstrap",
    "direction",
    "each",
    "expected_intervals",
    "first_order",
    "fit",
    "fit_in_pieces",
    "from_jacobian",
    "huber",
    "inertia",
    "interval",
    "jacobian_matrix",
    "jumps",
    "lbfgs",
    "load_fit",
    "make_problem",
    "positive",
    "prior",
    "profile",
    "read_csv",
    "real",
    "residual_vector",
    "rotation",
    "sample",
    "sandwich",
    "segments",
    "shares",
    "squares",
    "start_vector",
    "student",
    "through",
    "values_at",
    "with_profiles",
]
