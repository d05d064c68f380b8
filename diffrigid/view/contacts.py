"""stub"""
import numpy as np
def find_contacts(trajectory, t):
    return np.zeros((0, 2 + 2 * trajectory.world.dim))
