from .camchain import camchain_yaml as camchain_yaml
from .files import FILES as FILES
from .files import export_all as export_all
from .static_tf import static_tf_launch as static_tf_launch
from .tf_tree import tf_yaml as tf_yaml
from .urdf import urdf_xacro as urdf_xacro
