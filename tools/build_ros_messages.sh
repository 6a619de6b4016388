#!/bin/sh
# Builds tf2_msgs and simulation_interfaces, which PyPI lacks, for the ROS wheels of an environment,
# from Jazzy's public sources (minutes; needs git, cmake, make, g++ and Python's headers).
# tools/build_ros_messages.sh PREFIX; VENV=... chooses the environment, which is left as it is.
set -eu
if [ $# -ne 1 ]; then
    echo "usage: $0 PREFIX" >&2
    exit 2
fi
venv=$(cd "${VENV:-$(dirname "$0")/../.venv}" && pwd)
mkdir -p "$1"
prefix=$(cd "$1" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# Jazzy's rosidl_core has no branch of its own.
while read -r repository branch; do
    git -c advice.detachedHead=false clone --quiet --depth 1 --branch "$branch" \
        "https://github.com/$repository" "$work/src/$repository"
done <<REPOSITORIES
ament/ament_cmake jazzy
ament/ament_package jazzy
ros2/ament_cmake_ros jazzy
ros2/python_cmake_module jazzy
ros2/rosidl_core 0.2.0
ros2/rosidl_defaults jazzy
ros2/geometry2 jazzy
ros-simulation/simulation_interfaces jazzy
REPOSITORIES

# The wheels' CMake files name Python's headers on the machine that built them.
wheels=$work/wheels
mkdir "$wheels"
cp -R "$venv/share" "$wheels/share"
ln -s "$venv/bin" "$venv/include" "$venv/lib" "$wheels"
sed -i 's|\(INTERFACE_INCLUDE_DIRECTORIES\) "/opt/python.*"|\1 ""|' \
    "$wheels"/share/*/cmake/export_*__rosidl_generator_pyExport.cmake

# What a sourced ROS sets; nothing of one that is sourced here.
unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH
export PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$prefix:$wheels" CMAKE_PREFIX_PATH="$prefix:$wheels"
export COLCON_HOME="$work/home" COLCON_LOG_PATH="$work/log"
cd "$work"
build() {
    colcon build --base-paths src --merge-install --install-base "$prefix" \
        --executor sequential "$@" \
        --cmake-args -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release \
        "-DPython3_EXECUTABLE=$venv/bin/python"
}
# What the generators of the wheels ask for, then what they generate.
build --packages-up-to ament_cmake_ros python_cmake_module \
    rosidl_default_generators rosidl_default_runtime
build --packages-select tf2_msgs simulation_interfaces

packages=$("$venv/bin/python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
cat >"$prefix/use.sh" <<USE
export PYTHONPATH="$prefix/lib/$packages/site-packages\${PYTHONPATH:+:\$PYTHONPATH}"
export LD_LIBRARY_PATH="$prefix/lib\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}"
export AMENT_PREFIX_PATH="$prefix:$venv\${AMENT_PREFIX_PATH:+:\$AMENT_PREFIX_PATH}"
USE
echo "now: . $prefix/use.sh"
