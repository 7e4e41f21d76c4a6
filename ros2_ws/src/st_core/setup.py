from setuptools import find_packages, setup

package_name = 'st_core'

setup(
    name=package_name,
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/st_core']),
        ('share/st_core', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['hypothesis', 'pytest']},
    zip_safe=False,
    maintainer='The single-track authors',
    maintainer_email='single-track@example.org',
    description='Single-track vehicle models, prediction and evaluation. '
                'Pure Python: the equations use no ROS, clock or files.',
    license='Apache-2.0',
)
