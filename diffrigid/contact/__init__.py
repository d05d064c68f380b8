"""The contact model: exact impacts at their true times within a step, smooth ones for width > 0, and rest."""

from diffrigid.contact.impulse import contact_law
from diffrigid.contact.model import Contact

__all__ = ["Contact", "contact_law"]
