from .proposal import propose_rig as propose_rig
