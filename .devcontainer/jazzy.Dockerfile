# From the checkout's top:   docker build -f .devcontainer/jazzy.Dockerfile -t softrig-jazzy .
# The packages as a ROS workspace on a Jazzy installation; what each step does: softrig_bringup/doc/distribution.md
FROM ros:jazzy
RUN apt-get update && apt-get install -y --no-install-recommends python3-pip python3-venv && rm -rf /var/lib/apt/lists/*
WORKDIR /ws
COPY . src/softrig
RUN echo "yaml file:///ws/src/softrig/config/rosdep.yaml" >/etc/ros/rosdep/sources.list.d/10-softrig.list
RUN rosdep update --rosdistro jazzy
RUN python3 -m venv --system-site-packages venv && touch venv/COLCON_IGNORE
ENV PATH=/ws/venv/bin:$PATH SOFTRIG_VIEWER=none
RUN apt-get update && PIP_BREAK_SYSTEM_PACKAGES=1 rosdep install --from-paths src/softrig/ros_pkgs --ignore-src --rosdistro jazzy -y --as-root pip:false && rm -rf /var/lib/apt/lists/*
RUN . /opt/ros/jazzy/setup.sh && colcon build --base-paths src/softrig/ros_pkgs
RUN . install/setup.sh && colcon test --base-paths src/softrig/ros_pkgs && colcon test-result
CMD ["sh", "-c", ". install/setup.sh && ros2 launch softrig_bringup rig.launch.py scenario:=dc_motor_smc"]
