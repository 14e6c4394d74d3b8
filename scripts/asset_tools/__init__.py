"""What the asset builders share; needed only to rebuild the files of `refu_core/assets`."""
