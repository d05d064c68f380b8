"""System identification: from measured columns to parameters with intervals."""

from diffrigid.sysid.fit import Fit, Parameter, fit
from diffrigid.sysid.free import Free, interval, positive, real

__all__ = ["Fit", "Free", "Parameter", "fit", "interval", "positive", "real"]
