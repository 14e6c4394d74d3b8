"""Garments of one's own: a mesh is read, cleaned, placed on a body and bound to it."""

from refu_core.fitting._fit import CLEARANCE as CLEARANCE
from refu_core.fitting._fit import FittedGarment as FittedGarment
from refu_core.fitting._fit import GarmentDetails as GarmentDetails
from refu_core.fitting._fit import fit_garment as fit_garment
from refu_core.fitting._fit import stretch as stretch
from refu_core.fitting._mesh_file import SurfaceMesh as SurfaceMesh
from refu_core.fitting._mesh_file import read_surface as read_surface
from refu_core.fitting._placing import UNITS as UNITS
from refu_core.fitting._placing import Placing as Placing
from refu_core.fitting._posed import PosedBody as PosedBody
from refu_core.fitting._posed import standing_pose as standing_pose
from refu_core.fitting._transfer import Transfer as Transfer
