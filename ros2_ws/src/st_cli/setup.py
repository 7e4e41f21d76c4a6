from setuptools import find_packages, setup

package_name = "st_cli"

setup(
    name=package_name,
    version="0.2.0",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/st_cli"]),
        ("share/st_cli", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    maintainer="The single-track authors",
    maintainer_email="single-track@example.org",
    description="The st command: options and messages only.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "st = st_cli.__main__:main",
        ],
    },
)
