from setuptools import find_packages, setup

setup(
    name="st_live",
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "passenger.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_live"]),
        ("share/st_live", ["package.xml"]),
    ],
    extras_require={"test": ["pytest"]},
)
