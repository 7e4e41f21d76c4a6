from setuptools import find_packages, setup

package_name = 'canedge_bridge'

setup(
    name=package_name,
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/canedge_bridge']),
        ('share/canedge_bridge', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='The single-track authors',
    maintainer_email='single-track@example.org',
    description='CAN frames (live or logged) to ROS 2 topics through a DBC.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'canedge_bridge = canedge_bridge.node:main',
        ],
    },
)
