"""From a frame of body parameters to garments: what the node, the replay and a Python user call."""

from refu_core.realtime._contact import ContactStage as ContactStage
from refu_core.realtime._dress import Drape as Drape
from refu_core.realtime._dress import Dressed as Dressed
from refu_core.realtime._dress import dress as dress
from refu_core.realtime._frame import Adjust as Adjust
from refu_core.realtime._load import wearable_of as wearable_of
from refu_core.realtime._outputs import FrameStats as FrameStats
from refu_core.realtime._outputs import GarmentMesh as GarmentMesh
from refu_core.realtime._outputs import GarmentStats as GarmentStats
from refu_core.realtime._outputs import PipelineOutput as PipelineOutput
from refu_core.realtime._outputs import SkinShift as SkinShift
from refu_core.realtime._pipeline import GarmentPipeline as GarmentPipeline
from refu_core.realtime._promise import PROMISED_BEND as PROMISED_BEND
from refu_core.realtime._promise import PROMISED_POSES as PROMISED_POSES
from refu_core.realtime._promise import PROMISED_SIZE as PROMISED_SIZE
from refu_core.realtime._promise import SPINE as SPINE
from refu_core.realtime._promise import spine_bend as spine_bend
from refu_core.realtime._promise import within_promise as within_promise
from refu_core.realtime._turn import RootTurn as RootTurn
from refu_core.realtime._wearer import Outfit as Outfit
from refu_core.realtime._wearer import Wearable as Wearable
from refu_core.realtime._wearer import Wearer as Wearer
