from setuptools import find_packages, setup

package_name = 'st_ros'

setup(
    name=package_name,
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/st_ros']),
        ('share/st_ros', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='The single-track authors',
    maintainer_email='single-track@example.org',
    description='Code shared by the nodes: parameters with unit and range, diagnostics, stamps, clean exit.',
    license='Apache-2.0',
)
