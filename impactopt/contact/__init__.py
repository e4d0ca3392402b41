"""What is hit and how contact works: laws (force from penetration) and targets (motion from force)."""

from .laws import ContactLaw, SpringDamper
from .targets import FreeMass, Target

__all__ = ["ContactLaw", "FreeMass", "SpringDamper", "Target"]
