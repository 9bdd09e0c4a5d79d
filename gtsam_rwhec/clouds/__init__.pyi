from .cloud import Cloud as Cloud
from .object_views import ObjectOptions as ObjectOptions
from .object_views import SeenObject as SeenObject
from .object_views import ViewFault as ViewFault
from .object_views import ViewFinding as ViewFinding
from .object_views import motions as motions
from .object_views import seen_object as seen_object
from .registration import Registrations as Registrations
