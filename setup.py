"""Builds the ROS package `fetch_hand_sim`, with colcon or with pip alone."""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = 'fetch_hand_sim'

# To write ONNX actors; onnxruntime alone runs them.
ONNX = ['onnx>=1.17', 'onnxruntime>=1.20', 'onnxscript>=0.3']

# What test/ needs beyond the package itself. An extra called `test` makes `colcon test` use pytest.
TEST = [
    'colcon-core',
    'colcon-python-setup-py',
    'colcon-ros',
    'mcap-ros2-support',
    *ONNX,
    'pytest',
    'pytest-timeout',
    'setuptools',
    'stable-baselines3',
]

setup(
    name=PACKAGE,
    version='0.1.0',
    description='The Fetch and Shadow hand tasks of Plappert et al. 2018 as ROS 2 nodes on MuJoCo',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(
        include=[
            f'{name}{suffix}'
            for name in ('msgs_spec', 'fetch_hand_sim', 'policy_node')
            for suffix in ('', '.*')
        ]
    ),
    package_data={'policy_node': ['actors/*']},
    # Critics, to train on from a shipped actor: in the repository only.
    exclude_package_data={'policy_node': ['actors/*.training.safetensors']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.xml')),
        (f'share/{PACKAGE}/config', glob('config/*.yaml')),
    ],
    zip_safe=True,
    # Without rclpy and the messages: in a ROS workspace pip must not replace those of ROS.
    install_requires=[
        'gymnasium>=1.0',
        'gymnasium-robotics~=1.4.2',
        'lz4>=4',
        'mcap>=1.5',
        'mujoco~=4.0',
        'numpy>=1.26',
        'PyYAML>=6',
        'rich>=13',
        'rosbags>=0.10',
        'safetensors>=0.4',
        'torch>=2.6',
        'zstandard>=0.20',
    ],
    extras_require={
        # ROS 2 Jazzy itself, for a machine without it.
        'ros': ['ros-jazzy-common-interfaces', 'ros-jazzy-rclpy[fastrtps]'],
        'train': ['matplotlib', 'tensorboard'],
        'cluster': ['matplotlib', 'ray>=2.10'],
        # `export_episodes`.
        'export': ['minari>=0.5.3', 'pyarrow>=18'],
        'onnx': ONNX,
        'stable_baselines3': ['stable-baselines3>=2.4'],
        'test': TEST,
        'dev': [*TEST, 'mypy', 'pymcap-cli', 'ruff', 'types-PyYAML'],
    },
    entry_points={
        'console_scripts': [
            'sim_node = fetch_hand_sim.sim_node:main',
            'policy_node = policy_node.node:main',
            'export_actor = policy_node.policies.export_actor:main',
            'benchmark = policy_node.training.benchmark.command:main',
            'train_her = policy_node.training.train_her:main',
            'evaluate_policy = policy_node.training.evaluate_policy:main',
            'replay_node = fetch_hand_sim.replay_node:main',
            'list_episodes = fetch_hand_sim.commands.list_episodes:main',
            'check_episode = fetch_hand_sim.commands.check_episode:main',
            'recover_episodes = fetch_hand_sim.commands.recover_episodes:main',
            'export_episodes = fetch_hand_sim.commands.export_episodes:main',
            'generate_episodes = policy_node.training.generate_episodes:main',
        ],
        # Whoever ships actors says for which tasks; the demo asks without knowing the package.
        'fetch_hand_sim.actors': ['shipped = policy_node.policies.shipped:shipped_actors'],
    },
)
