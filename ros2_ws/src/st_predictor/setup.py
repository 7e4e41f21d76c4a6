from glob import glob

from setuptools import find_packages, setup

setup(
    name='st_predictor',
    version='0.2.0',
    packages=find_packages(exclude=['test']),
    package_data={'': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/st_predictor']),
        ('share/st_predictor', ['package.xml']),
        ('share/st_predictor/launch', glob('launch/*.launch.py')),
    ],
    extras_require={'test': ['pytest']},
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
