"""Signed distance to the posed body: the protocol, and its exact, approximate and neural implementations."""

from refu_core.sdf._approx import ApproxSdf as ApproxSdf
from refu_core.sdf._band import BAND as BAND
from refu_core.sdf._band import BandSdf as BandSdf
from refu_core.sdf._band import exact_sdf as exact_sdf
from refu_core.sdf._exact import ClosestPoints as ClosestPoints
from refu_core.sdf._exact import ExactSdf as ExactSdf
from refu_core.sdf._mesh import MeshSdf as MeshSdf
from refu_core.sdf._mesh import require_finite as require_finite
from refu_core.sdf._mesh import require_outward as require_outward
from refu_core.sdf._mesh import require_tensor as require_tensor
from refu_core.sdf._neural import SDF_PRESETS as SDF_PRESETS
from refu_core.sdf._neural import NeuralSdf as NeuralSdf
from refu_core.sdf._neural import SdfNetwork as SdfNetwork
from refu_core.sdf._neural import SdfNetworkConfig as SdfNetworkConfig
from refu_core.sdf._neural import body_frame as body_frame
from refu_core.sdf._neural import load_sdf_network as load_sdf_network
from refu_core.sdf._neural import save_sdf_network as save_sdf_network
from refu_core.sdf._neural import with_gradient as with_gradient
from refu_core.sdf._protocol import BodySdf as BodySdf
from refu_core.sdf._protocol import GarmentSdf as GarmentSdf
from refu_core.sdf._protocol import SdfSample as SdfSample
from refu_core.sdf._protocol import query_batch as query_batch
from refu_core.sdf._query_kernels import Skin as Skin
from refu_core.sdf._query_kernels import query_skin as query_skin
from refu_core.sdf._rest import RestFaces as RestFaces
from refu_core.sdf._winding import Winding as Winding
