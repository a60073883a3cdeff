"""Build interface packages that are not on PyPI, with names and fields of their own text.

The generators of the wheels turn definitions into C, which the system's compiler makes one Python
extension of for each package. The folder that holds them is made once, and found again by the
digest of the definitions.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path as FilePath

import numpy as np

DEFINITIONS = {
    "nav2_msgs/action/FollowPath.action": """
nav_msgs/Path path
string controller_id
string goal_checker_id
string progress_checker_id
---
uint16 NONE=0
uint16 UNKNOWN=100
uint16 INVALID_CONTROLLER=101
uint16 TF_ERROR=102
uint16 INVALID_PATH=103
uint16 PATIENCE_EXCEEDED=104
uint16 FAILED_TO_MAKE_PROGRESS=105
uint16 NO_VALID_CONTROL=106
uint16 CONTROLLER_TIMED_OUT=107
std_msgs/Empty result
uint16 error_code
string error_msg
---
float32 distance_to_goal
float32 speed
""",
    "nav2_msgs/msg/SpeedLimit.msg": """
std_msgs/Header header
bool percentage
float64 speed_limit
""",
    "tf2_msgs/msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
}
_PREFIX = FilePath(sys.prefix)
_SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
_DEPENDENCIES = (
    *("action_msgs", "builtin_interfaces", "geometry_msgs", "nav_msgs", "service_msgs"),
    *("std_msgs", "unique_identifier_msgs"),
)


def built_interfaces() -> FilePath:
    """Return a folder to import the packages from; RuntimeError if they cannot be built."""
    source = FilePath(__file__).read_text(encoding="utf-8")
    digest = hashlib.sha256(f"{source}{sys.prefix}{sys.version}".encode()).hexdigest()[:16]
    folder = FilePath(tempfile.gettempdir()) / f"adp_test_interfaces_{os.getuid()}_{digest}"
    if folder.is_dir():
        return folder
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix="adp_build_") as temporary:
        made = FilePath(temporary) / "made"
        for package in sorted({name.partition("/")[0] for name in DEFINITIONS}):
            _build(package, FilePath(temporary) / "work" / package, made / package)
        try:
            made.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another test run was faster
                raise
    return folder


def _build(package: str, work: FilePath, target: FilePath) -> None:
    """Generate the code of a package and compile it."""
    from rosidl_adapter import convert_to_idl
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_support
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    idl = []
    for name, text in DEFINITIONS.items():
        if not name.startswith(f"{package}/"):
            continue
        relative = FilePath(*name.split("/")[1:])
        (work / relative).parent.mkdir(parents=True, exist_ok=True)
        (work / relative).write_text(text, encoding="utf-8")
        made = convert_to_idl(work, package, relative, work / "idl")
        idl.append(str(made.relative_to(work / "idl")))

    def arguments(generator: str, output: FilePath) -> str:
        file = work / f"{generator}.json"
        content = {
            "package_name": package,
            "output_dir": str(output),
            "template_dir": str(_PREFIX / "share" / generator / "resource"),
            "idl_tuples": [f"{work / 'idl'}:{path}" for path in idl],
            "include_paths": [f"{name}:{_PREFIX / 'share' / name}" for name in _DEPENDENCIES],
            "target_dependencies": [],
            "type_description_tuples": [
                f"{path}:{(described / path).with_suffix('.json')}"
                for path in idl
                if generator != "rosidl_generator_type_description"
            ],
        }
        file.write_text(json.dumps(content), encoding="utf-8")
        return str(file)

    described = work / "description"
    generate_type_hash(arguments("rosidl_generator_type_description", described))
    code = work / "code" / package
    generate_c(arguments("rosidl_generator_c", code))
    generate_typesupport_fastrtps_c(arguments(_SUPPORTS[0], code))
    generate_introspection(arguments(_SUPPORTS[1], work / "code" / "more" / package))
    generate_support(arguments("rosidl_typesupport_c", code), _SUPPORTS)
    generate_py(arguments("rosidl_generator_py", target), ["rosidl_typesupport_c"])
    (target / "__init__.py").touch()
    for generator in ("rosidl_generator_c", *_SUPPORTS):
        name = f"{generator}__visibility_control.h"
        text = (_PREFIX / "share" / generator / "resource" / f"{name}.in").read_text("utf-8")
        text = text.replace("@PROJECT_NAME@", package)
        text = text.replace("@PROJECT_NAME_UPPER@", package.upper())
        (code / "msg" / name).write_text(text, encoding="utf-8")
    _compile(package, work / "code", target)


def _compile(package: str, code: FilePath, target: FilePath) -> None:
    """Make one extension of all generated C and C++."""
    include = [sysconfig.get_path("include"), np.get_include(), code, code / "more"]
    include.append(_PREFIX / "include")
    include += [folder for folder in (_PREFIX / "include").iterdir() if folder.is_dir()]
    objects = []
    sources = sorted([*code.rglob("*.c"), *code.rglob("*.cpp"), *target.rglob("*.c")])
    for number, source in enumerate(sources):
        made = code / f"{number}.o"
        _run(
            "g++" if source.suffix == ".cpp" else "gcc",
            *("-c", "-O0", "-fPIC", "-w", str(source), "-o", str(made)),
            *(f"-I{folder}" for folder in include),
        )
        objects.append(str(made))
    libraries = [
        f"-l{name}__{kind}"
        for name in _DEPENDENCIES
        for kind in (
            "rosidl_generator_c",
            "rosidl_generator_py",
            "rosidl_typesupport_c",
            *_SUPPORTS,
        )
    ]
    libraries += ["-lfastcdr", "-lrmw", "-lrcutils", "-lrosidl_runtime_c"]
    libraries += [f"-l{name}" for name in ("rosidl_typesupport_c", *_SUPPORTS)]
    wheels = (f"-L{_PREFIX / 'lib'}", f"-Wl,-rpath,{_PREFIX / 'lib'}", "-Wl,-rpath,$ORIGIN")
    # rmw opens these by their names, which are known once the extension below has loaded them.
    first, second = (f"lib{package}__{kind}.so" for kind in _SUPPORTS)
    made = ("g++", "-shared", "-Wl,--no-as-needed")
    place = target.parent
    _run(*made, f"-Wl,-soname,{first}", "-o", str(place / first), *objects, *wheels, *libraries)
    own = (f"-L{place}", f"-l:{first}")
    _run(*made, f"-Wl,-soname,{second}", "-o", str(place / second), *own, "-Wl,-rpath,$ORIGIN")
    extension = str(target / f"{package}_s__rosidl_typesupport_c.so")
    _run(*made, "-o", extension, *own, f"-l:{second}", "-Wl,-rpath,$ORIGIN/..")


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[:8])} ...: {done.stderr}")


if __name__ == "__main__":
    print(built_interfaces())
