"""Build the ROS package `fetch_hand_sim`, with colcon or with pip alone."""

import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

# Before pip, which reads `python_requires` only after it has downloaded the dependencies.
if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(f'fetch_hand_sim needs Python 3.11 or newer; this is {sys.version.split()[0]}')

PACKAGE = 'fetch_hand_sim'

# For training and for actors as modules; NumPy alone runs actors.
ACTORS = ['torch>=2.6']
# Extras of single commands; a command names its missing extra.
EXTRAS = {
    # ROS 2 Jazzy, for machines without it.
    'ros': ['ros-jazzy-common-interfaces', 'ros-jazzy-rclpy[fastrtps]'],
    'actors': ACTORS,
    'train': [*ACTORS, 'matplotlib>=3.8', 'tensorboard>=2.16'],
    # `fetch_hand_sim episodes export`.
    'data': ['minari>=0.5.3', 'pyarrow>=18'],
    'sb3': [*ACTORS, 'stable-baselines3>=2.4'],
    # To write ONNX actors; onnxruntime alone runs them.
    'onnx': ['onnx>=1.17', 'onnxruntime>=1.20', 'onnxscript>=0.3'],
    # `fetch_hand_sim episodes film` to .mp4.
    'film': ['imageio-ffmpeg>=0.5'],
    # `benchmark --ray`.
    'cluster': [*ACTORS, 'matplotlib>=3.8', 'ray>=2.10'],
}
# `make docs`; docutils 0.23 is too new for Sphinx 9.0.
DOCS = ['furo>=2025.12', 'myst-parser>=5', 'sphinx>=9,<10']
# Further packages for test/. An extra called `test` makes `colcon test` use pytest.
TEST = [
    'colcon-core',
    'colcon-package-selection',
    'colcon-python-setup-py',
    'colcon-ros',
    'grimp',
    'import-linter',
    'mcap-ros2-support',
    'pytest',
    'pytest-rerunfailures',
    'pytest-timeout',
    'pytest-xdist',
    # colcon-core needs it below 80.
    'setuptools<80',
    'yourdfpy',
]

setup(
    name=PACKAGE,
    version='2.0.0',
    description='The Fetch and Shadow hand tasks of Plappert et al. 2018 as ROS 2 nodes on MuJoCo',
    # Resolved: `colcon build --symlink-install` links this file alone.
    long_description=Path(__file__).resolve().with_name('README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    license_files=['LICENSE', 'NOTICE'],
    author='The fetch_hand_sim maintainers',
    project_urls={'Paper': 'https://arxiv.org/abs/1802.09464'},
    keywords=['robotics', 'reinforcement learning', 'mujoco', 'ros2', 'gymnasium', 'her', 'mcap'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3 :: Only',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(11, 15)),
        'Topic :: Scientific/Engineering :: Artificial Intelligence',
        'Typing :: Typed',
    ],
    python_requires='>=3.11',
    packages=find_packages(
        include=[
            f'{name}{suffix}'
            for name in ('msgs_spec', 'node_runtime', 'fetch_hand_sim', 'policy_node')
            for suffix in ('', '.*')
        ]
    ),
    package_data={
        'msgs_spec': ['py.typed'],
        'node_runtime': ['py.typed', '*.xml'],
        'fetch_hand_sim': ['py.typed'],
        'policy_node': ['py.typed', 'actors/*'],
    },
    # Critics of the shipped actors are in the repository only.
    exclude_package_data={'policy_node': ['actors/*.training.safetensors']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml', 'LICENSE', 'NOTICE']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.xml')),
        (f'share/{PACKAGE}/config', glob('config/*.*')),
    ],
    zip_safe=True,
    # Without rclpy and the messages: in a ROS workspace, pip must not replace them. Without `~=`:
    # colcon cannot read it; `colcon test` would pass without running tests.
    install_requires=[
        'gymnasium>=1.2',
        'gymnasium-robotics>=1.4.2,<1.5',
        'lz4>=4',
        'mcap>=1.5',
        'mujoco>=4.0,<5',
        'numpy>=1.26',
        'pillow>=8.3.2',
        'PyYAML>=6',
        'rich>=13',
        'rosbags>=0.10.8',
        'safetensors>=0.4',
        'shtab>=1.7',
        'threadpoolctl>=3',
        'websockets>=13',
        'zstandard>=0.20',
    ],
    extras_require={
        **EXTRAS,
        'all': sorted({each for needed in EXTRAS.values() for each in needed}),
        'docs': DOCS,
        'test': TEST,
        'dev': [*TEST, 'mypy', 'pymcap-cli', 'ruff', 'types-PyYAML'],
    },
    entry_points={
        'console_scripts': [
            # Every command; the others are for `ros2 run`.
            'fetch_hand_sim = fetch_hand_sim.__main__:main',
            'sim_node = fetch_hand_sim.sim_node:main',
            'policy_node = policy_node.node:main',
            'replay_node = fetch_hand_sim.replay_node:main',
            'visualization_node = fetch_hand_sim.visualization_node:main',
            'view = fetch_hand_sim.view:main',
        ],
        # Functions that return the shipped actors by task; `fetch_hand_sim` imports no policy.
        'fetch_hand_sim.actors': ['shipped = policy_node.policies.loading:shipped_actors'],
    },
)
