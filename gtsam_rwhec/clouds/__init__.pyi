from .cloud import Cloud as Cloud
from .registered_views import ObjectOptions as ObjectOptions
from .object_views import SeenObject as SeenObject
from .registered_views import ViewFault as ViewFault
from .registered_views import ViewFinding as ViewFinding
from .object_views import motions as motions
from .object_views import seen_object as seen_object
from .registration import Registrations as Registrations
