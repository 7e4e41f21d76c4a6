from setuptools import find_packages, setup

package_name = 'oxts_bridge'

setup(
    name=package_name,
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/oxts_bridge']),
        ('share/oxts_bridge', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='The single-track authors',
    maintainer_email='single-track@example.org',
    description='OxTS NCOM (UDP or file) to ROS 2 topics: codec, converter, lifecycle node.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'oxts_bridge = oxts_bridge.node:main',
        ],
    },
)
