from .rig_from_look import first_rig as first_rig
