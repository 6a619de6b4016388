# ROS 2 Jazzy with this package built in a workspace. UNTESTED: it could not be built where it was
# written. The steps are those of CONTRIBUTING.md, which are tested.
#   docker build -t fetch_hand_sim .
#   docker run --rm -it fetch_hand_sim ros2 launch fetch_hand_sim demo.launch.xml episodes:=5
FROM ros:jazzy-ros-base

RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-venv python3-pip libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /ros2_ws
RUN python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE
ENV PATH=/ros2_ws/venv/bin:$PATH MUJOCO_GL=egl

# NumPy 1, because the messages of ROS Jazzy are built against it. PyTorch's CPU index spares
# gigabytes: --build-arg PIP_OPTIONS='--extra-index-url <index>', as in CONTRIBUTING.md.
ARG PIP_OPTIONS=
RUN pip install --no-cache-dir $PIP_OPTIONS \
        'numpy<2' 'setuptools<80' gymnasium gymnasium-robotics==1.4.2 lz4 mcap mujoco==4.0.0 pillow rich rosbags safetensors shtab \
        threadpoolctl torch==2.13.0 websockets zstandard

COPY . src/fetch_hand_sim
RUN . /opt/ros/jazzy/setup.sh && python3 -m colcon build --packages-select fetch_hand_sim

RUN printf '#!/bin/sh\nset -e\n. /opt/ros/jazzy/setup.sh\n. /ros2_ws/install/setup.sh\nexec "$@"\n' \
        > /entrypoint.sh && chmod +x /entrypoint.sh
ENTRYPOINT ["/entrypoint.sh"]
CMD ["ros2", "launch", "fetch_hand_sim", "demo.launch.xml"]
