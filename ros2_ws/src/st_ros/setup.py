from setuptools import find_packages, setup

setup(
    name='st_ros',
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/st_ros']),
        ('share/st_ros', ['package.xml']),
    ],
    extras_require={'test': ['pytest']},
)
