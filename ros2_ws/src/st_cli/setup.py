from setuptools import find_packages, setup

setup(
    name="st_cli",
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_cli"]),
        ("share/st_cli", ["package.xml"]),
    ],
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["st = st_cli.__main__:main"]},
)
