# SPDX-License-Identifier: Apache-2.0
"""``flexarm report``: what recorded runs show, on one page of HTML that needs nothing else.

``serialised`` turns many messages into columns of numbers at once, ``bag`` reads a bag of any length through
them into files of columns, ``timeline`` puts samples in order and on one axis of time, ``run`` joins the topics,
``analysis`` computes what is told, ``animation`` the arm's shape, ``figures`` draws, ``page`` writes.
"""
