"""What later stages take from inside io: whole files only, optional packages, and the bins of MERL materials."""

from shisd.io._files import optional as optional
from shisd.io._files import ordinary as ordinary
from shisd.io._files import read_npz as read_npz
from shisd.io._files import write_atomically as write_atomically
from shisd.io._merl import MERL_BINS as MERL_BINS
from shisd.io._merl import merl_above_horizon as merl_above_horizon
from shisd.io._merl import merl_directions as merl_directions
