from glob import glob

from setuptools import find_packages, setup

package_name = 'st_predictor'

setup(
    name=package_name,
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/st_predictor']),
        ('share/st_predictor', ['package.xml']),
        ('share/st_predictor/launch', glob('launch/*.launch.py')),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='The single-track authors',
    maintainer_email='single-track@example.org',
    description='Predictor, evaluator, recorder, markers and identifier nodes, and the launch files of the suite.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'predictor = st_predictor.nodes.predictor:main',
            'evaluator = st_predictor.nodes.evaluator:main',
            'recorder = st_predictor.nodes.recorder:main',
            'markers = st_predictor.nodes.markers:main',
            'identifier = st_predictor.nodes.identifier:main',
        ],
    },
)
