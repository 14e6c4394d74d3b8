"""Garments: their files, how they follow shape and style, how they are posed and unposed."""

from refu_core.frames import N_STYLES as N_STYLES
from refu_core.garments._below import SkinBelow as SkinBelow
from refu_core.garments._file import garment_files as garment_files
from refu_core.garments._file import garment_name as garment_name
from refu_core.garments._file import garments_folder as garments_folder
from refu_core.garments._file import load_garment as load_garment
from refu_core.garments._file import require_name as require_name
from refu_core.garments._file import save_garment as save_garment
from refu_core.garments._template import GarmentCard as GarmentCard
from refu_core.garments._template import GarmentTemplate as GarmentTemplate
from refu_core.garments._template import Tailoring as Tailoring
from refu_core.garments._template import UvMap as UvMap
from refu_core.garments._template import card_to_json as card_to_json
from refu_core.garments._template import inner_first as inner_first
from refu_core.garments._transfer import worn_on as worn_on
from refu_core.modes import BUILTIN_GARMENTS as BUILTIN_GARMENTS
from refu_core.modes import DEFAULT_GARMENTS as DEFAULT_GARMENTS
from refu_core.modes import PAPER_GARMENTS as PAPER_GARMENTS
