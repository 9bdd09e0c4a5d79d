from .atomic_write import atomic_stream as atomic_stream
from .atomic_write import write_atomically as write_atomically
from .natural_order import natural_key as natural_key
from .progress import Progress as Progress
from .terminal_text import printable as printable
from .yaml_lines import YamlFile as YamlFile
from .yaml_lines import parse_yaml as parse_yaml
from .yaml_lines import read_yaml as read_yaml
