"""What robots and planners need to know of dressed people besides meshes; each part is computed only on request."""

from refu_core.outputs._clearance import REACH as REACH
from refu_core.outputs._clearance import Clearance as Clearance
from refu_core.outputs._dressed import DressedPerson as DressedPerson
from refu_core.outputs._dressed import Fittings as Fittings
from refu_core.outputs._limbs import PRESSED as PRESSED
from refu_core.outputs._limbs import LimbContact as LimbContact
from refu_core.outputs._limbs import LimbContacts as LimbContacts
from refu_core.outputs._openings import Opening as Opening
from refu_core.outputs._openings import Openings as Openings
from refu_core.outputs._planner import HALF_THICKNESS as HALF_THICKNESS
from refu_core.outputs._planner import MAX_TRIANGLES as MAX_TRIANGLES
from refu_core.outputs._planner import PlannerMesh as PlannerMesh
from refu_core.outputs._sigma import RADIUS_90 as RADIUS_90
from refu_core.outputs._sigma import UNKNOWN_SIGMA as UNKNOWN_SIGMA
from refu_core.outputs._sigma import Sigma as Sigma
from refu_core.outputs._sigma import SigmaMap as SigmaMap
from refu_core.outputs._sigma import bend_of as bend_of
from refu_core.outputs._sigma import fit_sigma as fit_sigma
from refu_core.outputs._sigma import load_sigma as load_sigma
from refu_core.outputs._sigma import save_sigma as save_sigma
from refu_core.outputs._visible import PinholeCamera as PinholeCamera
from refu_core.outputs._visible import all_visible as all_visible
from refu_core.outputs._visible import depth_image as depth_image
from refu_core.outputs._visible import visible as visible
