from setuptools import find_packages, setup

setup(
    name="st_offline",
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.jinja"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_offline"]),
        ("share/st_offline", ["package.xml"]),
    ],
    extras_require={"test": ["pytest"]},
)
