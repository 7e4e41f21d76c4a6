from setuptools import find_packages, setup

setup(
    name='canedge_bridge',
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/canedge_bridge']),
        ('share/canedge_bridge', ['package.xml']),
    ],
    extras_require={'test': ['pytest']},
    entry_points={'console_scripts': ['canedge_bridge = canedge_bridge.node:main']},
)
