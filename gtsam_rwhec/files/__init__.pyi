from .whole_files import atomic_stream as atomic_stream
from .whole_files import write_atomically as write_atomically
from .terminal_text import natural_key as natural_key
from .progress import Progress as Progress
from .terminal_text import printable as printable
from .yaml_lines import YamlFile as YamlFile
from .yaml_lines import parse_yaml as parse_yaml
from .yaml_lines import read_yaml as read_yaml
