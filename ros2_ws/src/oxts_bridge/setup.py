from setuptools import find_packages, setup

setup(
    name='oxts_bridge',
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/oxts_bridge']),
        ('share/oxts_bridge', ['package.xml']),
    ],
    extras_require={'test': ['pytest']},
    entry_points={'console_scripts': ['oxts_bridge = oxts_bridge.node:main']},
)
